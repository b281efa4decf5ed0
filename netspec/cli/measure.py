"""``netspec test`` and ``netspec time``."""

from __future__ import annotations

import argparse

from netspec.cli.arguments import (
    add_device,
    add_engine,
    add_exact,
    add_model,
    add_passes,
    add_python,
    add_state,
    add_strict,
    load,
    load_weights,
    positive,
    run_by,
)
from netspec.cli.run import BUILT, Commands
from netspec.inspect.logs.scores import Score, Scores
from netspec.proto.binary import check_readable, split_paths


def add_to(commands: Commands) -> None:
    """Add the commands."""
    p = commands.add("test", _test, "score a model on its TEST-phase data (caffe test)", net=BUILT)
    add_model(p)
    p.add_argument("--weights", required=True, help="the trained weights")
    p.add_argument("--iterations", type=positive, default=50, help="batches to run (default: 50)")
    p.add_argument("--scores", metavar="F.json", help="also write the mean scores to this file")
    add_device(p)
    add_state(p, phase=None)
    add_python(p)
    add_exact(p)
    add_passes(p)
    add_strict(p)
    add_engine(p)

    p = commands.add("time", _time, "measure the forward and backward time of each layer (caffe time)", net=BUILT)
    add_model(p)
    p.add_argument("--iterations", type=positive, default=50, help="passes to time (default: 50)")
    add_device(p)
    add_state(p, phase="TRAIN")
    add_python(p)
    add_exact(p)
    p.set_defaults(passes=())  # each layer is timed by itself
    add_engine(p)


def _test(arguments: argparse.Namespace) -> None:
    from netspec.inspect.check.measure import test_net

    check_readable(split_paths(arguments.weights))
    net = load(arguments, "TEST", "caffe.cpp:266", "caffe.cpp:275")
    load_weights(net, arguments.weights, arguments.strict)
    net = run_by(net, arguments, arguments.weights)
    means = test_net(net, arguments.iterations)
    net.close()
    if arguments.scores:
        Scores([Score(None, 0, means)]).write(arguments.scores)


def _time(arguments: argparse.Namespace) -> None:
    from netspec.inspect.check.measure import time_forward, time_net

    net = load(arguments, arguments.phase, "caffe.cpp:340", "caffe.cpp:343", write_files=False)
    run_by(net, arguments, None)
    if net.runners[0] in (net.prepared, net.eager):  # an engine's kernels are not by layer
        time_net(net, arguments.iterations)
    else:
        time_forward(net, arguments.iterations)
    net.close()
