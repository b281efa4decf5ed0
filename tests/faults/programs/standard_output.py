import argparse, sys, types
from netspec.terminal.main import program
from netspec.terminal.commands import Commands, run

def main(words):
    parser = argparse.ArgumentParser()
    Commands(parser).add("say", lambda arguments: print(*words), "")
    return run(parser, ["say"])

sys.modules["commands"] = types.SimpleNamespace(main=main)
sys.exit(program("commands", sys.argv[1:]))
