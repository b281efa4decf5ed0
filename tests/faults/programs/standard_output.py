import sys, types
from netspec.terminal.main import program
from netspec.terminal.commands import run
from netspec.terminal.parser import Commands, Parser

def main(words):
    parser = Parser()
    Commands(parser).add_parser("say", lambda arguments: print(*words), help="")
    return run(parser, ["say"])

sys.modules["commands"] = types.SimpleNamespace(main=main)
sys.exit(program("commands", sys.argv[1:]))
