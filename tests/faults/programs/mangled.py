import sys, time
from netspec.terminal.commands import run
from netspec.terminal.parser import Commands, Parser

def loading(arguments):
    try:
        print("begun", flush=True)
        time.sleep(60)
    except BaseException:
        raise ImportError("initialization failed")

parser = Parser()
Commands(parser).add_parser("loading", help="").set_defaults(function=loading)
sys.exit(run(parser, ["loading"]))
