import ctypes, sys, time
from netspec.terminal.commands import run
from netspec.terminal.parser import Commands, Parser

def loading(arguments):
    names = ctypes.py_object({"print": print, "time": time})
    ctypes.pythonapi.PyRun_String(b"print('begun', flush=True)\nwhile True: time.sleep(0.01)", 257, names, names)

ctypes.pythonapi.PyRun_String.restype = ctypes.py_object
parser = Parser()
Commands(parser).add_parser("loading", help="").set_defaults(function=loading)
sys.exit(run(parser, ["loading"]))
