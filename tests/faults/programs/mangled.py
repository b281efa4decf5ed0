import argparse, sys, time
from netspec.terminal.commands import Commands, run

def loading(arguments):
    try:
        print("begun", flush=True)
        time.sleep(60)
    except BaseException:
        raise ImportError("initialization failed")

parser = argparse.ArgumentParser()
Commands(parser).add("loading", loading, "")
sys.exit(run(parser, ["loading"]))
