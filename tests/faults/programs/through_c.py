import argparse, ctypes, sys, time
from netspec.terminal.commands import Commands, run

def loading(arguments):
    names = ctypes.py_object({"print": print, "time": time})
    ctypes.pythonapi.PyRun_String(b"print('begun', flush=True)\nwhile True: time.sleep(0.01)", 257, names, names)

ctypes.pythonapi.PyRun_String.restype = ctypes.py_object
parser = argparse.ArgumentParser()
Commands(parser).add("loading", loading, "")
sys.exit(run(parser, ["loading"]))
