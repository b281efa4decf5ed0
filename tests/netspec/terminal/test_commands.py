"""How every command reads its words, logs and ends: gflags' spellings, glog's form, one line for a fault."""

import argparse
import logging
import re
import signal
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import pytest

from netspec import log
from netspec.errors import SpecError, Where
from netspec.terminal.commands import Interrupted, WrongUsage, interruptible, refuse, run
from netspec.terminal.parser import Commands, Parser


def command(function: Callable[[argparse.Namespace], int | None]) -> Parser:
    parser = Parser("program")
    added = Commands(parser).add_parser("convert", function, help="a command")
    added.add_argument("--gray", action="store_true", help="read images as gray")
    added.add_argument("--train", action="store_true", default=True)
    added.add_argument("--check_size", action="store_true")
    group = added.add_argument_group("more")
    group.add_argument("--at-most", action="store_true")
    added.add_argument("--resize_width", type=int, default=0)
    added.add_argument("--shift", type=float, default=0.0)
    added.add_argument("names", nargs="*")
    return parser


def read(*words: str) -> argparse.Namespace:
    found: list[argparse.Namespace] = []
    assert run(command(lambda arguments: found.append(arguments)), ["convert", *words]) == 0
    return found[0]


@pytest.mark.parametrize(
    "words", ["-gray", "--gray", "-gray=true", "--gray=1", "--gray=T", "-nogray -gray", "-gray=Yes"]
)
def test_a_boolean_flag_is_set_in_each_of_gflags_spellings(words: str) -> None:
    assert read(*words.split(), "a", "b").gray is True


@pytest.mark.parametrize("words", ["", "-nogray", "--nogray", "-gray=false", "--gray=no", "--no-gray", "-gray -gray=0"])
def test_a_boolean_flag_is_cleared_in_each_of_gflags_spellings(words: str) -> None:
    assert read(*words.split(), "a", "b").gray is False


def test_a_boolean_flag_never_takes_the_next_word() -> None:
    arguments = read("--check_size", "-gray", "false", "true")
    assert (arguments.gray, arguments.check_size, arguments.names) == (True, True, ["false", "true"])


def test_flags_of_groups_and_flags_with_dashes_work_the_same() -> None:
    assert read("-at-most").at_most
    assert not read("-at-most", "--noat-most").at_most
    assert [read(*words).train for words in ([], ["--no-train"], ["-notrain"], ["--train=f"])] == [True, *[False] * 3]


@pytest.mark.parametrize("words", ["-resize_width 64", "-resize_width=64", "--resize_width 64", "--resize_width=64"])
def test_other_flags_have_a_value(words: str) -> None:
    assert read(*words.split(), "a", "b").resize_width == 64


def test_values_can_be_negative_numbers() -> None:
    assert read("-shift", "-1.5").shift == -1.5
    assert read("--shift=-2").shift == -2


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["-gray=maybe"], "argument --gray: found 'maybe', expected true or false"),
        (["-no-gray=true"], "unrecognized arguments: --no-gray=true"),
        (["-resize", "64"], 'unrecognized arguments: --resize; did you mean "--resize_width"?'),
        (["-resize_width=x"], "argument --resize_width: invalid int value: 'x'"),
        (["-color"], "unrecognized arguments: --color"),
    ],
)
def test_misspelled_flags_end_with_status_2(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(command(lambda arguments: None), ["convert", *words]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("module", ["netspec.cli", "lmdb_build.cli"])
def test_a_program_prints_its_version_and_suggests_commands(module: str, capsys: pytest.CaptureFixture[str]) -> None:
    made = import_module(module).parser()
    for spelling in ("--version", "-version"):
        assert run(made, [spelling]) == 0
        assert re.fullmatch(rf"{made.prog} [\w.+]+\n", capsys.readouterr().out)
    (commands,) = (a for a in made._actions if isinstance(a, argparse._SubParsersAction))
    for name in commands.choices:
        assert run(made, [f"{name[:-1]}_{name[-1]}"]) == 2
        assert capsys.readouterr().err.endswith(
            f'there is no command "{name[:-1]}_{name[-1]}"; did you mean "{name}"?\n'
        )
    assert run(made, ["xyzzy"]) == 2
    assert capsys.readouterr().err.endswith(f'there is no command "xyzzy"; see {made.prog} --help\n')


def test_the_usage_of_the_command_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(command(lambda arguments: None), ["convert", "--gary"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("usage: program convert [-h]")
    assert said.endswith('program convert: error: unrecognized arguments: --gary; did you mean "--gray"?\n')


def test_given_options_can_be_refused(capsys: pytest.CaptureFixture[str]) -> None:
    made = command(lambda arguments: refuse(arguments, ("gray", "shift"), "is for others"))
    for words, status in ((["-shift=0"], 2), (["-nogray"], 2), (["--", "--shift"], 0), (["-resize_width", "3"], 0)):
        assert run(made, ["convert", *words]) == status
    assert "program convert: error: --shift is for others\n" in capsys.readouterr().err


def test_commands_in_groups_have_their_own_options() -> None:
    parser = Parser("program")
    group = Commands(parser).add_group("look", help="commands that draw")
    found: list[argparse.Namespace] = []
    maps = group.add_parser("maps", found.append, help="draw maps")
    maps.add_argument("-v", action="store_true")
    maps.add_argument("--out")
    assert run(parser, ["look", "maps", "-v", "-out", "a.png"]) == 0
    assert (found[0].v, found[0].out) == (True, "a.png")


@pytest.mark.parametrize(
    ("folder", "out", "line"),
    [
        (False, "no/x.png", "no/x.png: cannot be written: No such file or directory\n"),
        (False, "file/x.png", "file/x.png: cannot be written: Not a directory\n"),
        (True, "file/x", "file/x: cannot be written: Not a directory\n"),
        (False, "x.png", ""),
        (True, "new/x", ""),
    ],
    ids=["missing_folder", "file_for_folder", "folder_in_file", "file", "new_folders"],
)
def test_outputs_are_checked_before_the_command_begins(
    folder: bool,
    out: str,
    line: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    parser = Parser("program")
    began: list[argparse.Namespace] = []
    command = Commands(parser).add_parser("draw", began.append, help="draw")
    command.add_output("--out", folder=folder)
    assert run(parser, ["draw", "--out", out]) == (1 if line else 0)
    assert capsys.readouterr().err == line
    assert len(began) == (not line)


def test_a_flag_of_one_letter_has_no_opposite(capsys: pytest.CaptureFixture[str]) -> None:
    parser = Parser("program")
    found: list[argparse.Namespace] = []
    added = Commands(parser).add_parser("convert", found.append, help="a command")
    added.add_argument("-m", action="store_true", help="run a module")
    assert run(parser, ["convert"]) == run(parser, ["convert", "-m"]) == 0
    assert [arguments.m for arguments in found] == [False, True]
    assert run(parser, ["convert", "--no"]) == 2
    assert "unrecognized arguments: --no" in capsys.readouterr().err
    assert "  -m          run a module\n" in added.format_help()


# The log


@pytest.mark.parametrize(
    ("words", "variable", "shown"),
    [
        ([], None, "IWE"),
        (["-logtostderr", "--alsologtostderr=1"], None, "IWE"),
        (["-minloglevel=1"], None, "WE"),
        (["-q"], None, "WE"),
        ([], "2", "E"),
        (["--minloglevel", "0"], "2", "IWE"),
        ([], "9", ""),
    ],
)
def test_glogs_own_flags_and_variable(
    words: list[str],
    variable: str | None,
    shown: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def speak(arguments: argparse.Namespace) -> None:
        for say in (log.info, log.warning, log.error):
            say("caffe.cpp:1", "hello")

    monkeypatch.delenv("GLOG_minloglevel", raising=False)
    if variable is not None:
        monkeypatch.setenv("GLOG_minloglevel", variable)
    assert run(command(speak), ["convert", *words]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert "".join(line[0] for line in lines) == shown
    assert all(line.endswith(" caffe.cpp:1] hello") for line in lines)


def test_the_logger_is_restored() -> None:
    before = log.logger.level, log.logger.propagate, list(log.logger.handlers)
    read()
    assert (log.logger.level, log.logger.propagate, log.logger.handlers) == before


# How a command ends


class Fault(SpecError):
    """The error of another package."""


@pytest.mark.parametrize(
    ("error", "status", "said"),
    [
        (SpecError("wrong", Where("net.prototxt", 3, 4)), 1, "net.prototxt:3:4: wrong\n"),
        (Fault("list.txt:1:1: wrong"), 1, "list.txt:1:1: wrong\n"),
        (PermissionError(13, "Permission denied", "out/db"), 1, "out/db: Permission denied\n"),
        (OSError("no space"), 1, "no space\n"),
        (WrongUsage("a and b do not go together"), 2, "program convert: error: a and b do not go together\n"),
        (KeyboardInterrupt(), 130, "interrupted\n"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_each_error_has_its_status_and_one_line(
    error: BaseException, status: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(arguments: argparse.Namespace) -> None:
        raise error

    assert run(command(fail), ["convert"]) == status
    assert capsys.readouterr().err == said
    assert not log.logger.handlers or all(type(h) is not logging.StreamHandler for h in log.logger.handlers)


def test_programming_errors_are_not_hidden() -> None:
    def fail(arguments: argparse.Namespace) -> None:
        raise AssertionError("a mistake in the program")

    with pytest.raises(AssertionError):
        run(command(fail), ["convert"])


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_signal_in_a_finalizer_is_not_lost() -> None:
    class Ended:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGTERM)

    with pytest.raises(Interrupted), interruptible():
        Ended()
