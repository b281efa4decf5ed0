"""Nets of different forks beside each other, in one process and in several threads."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from netspec.net.net import Net

INPUT = 'layer { name: "x" type: "Input" top: "x" input_param { shape { dim: 1 dim: 4 dim: 6 dim: 6 } } } '
LOSS = INPUT + 'layer { name: "l" type: "SigmoidCrossEntropyLoss" bottom: "x" bottom: "x" top: "l" }'


def test_two_forks_that_change_the_same_layer_do_not_see_each_other(net_of: Callable[..., Net]) -> None:
    for _ in range(2):
        for fork in ("hed", "rcf", ""):
            layer = net_of(f"# dialect: {fork}\n{LOSS}" if fork else LOSS).layers[-1]
            assert type(layer).__module__.rpartition(".")[2] == (fork or "losses")


FIRST = """
import sys, threading
import netspec
sys.setswitchinterval(1e-5)
faults, gate = [], threading.Barrier(8)

def load(path):
    gate.wait()
    try:
        netspec.load_net(path, seed=1)
    except Exception as fault:
        faults.append(str(fault))

threads = [threading.Thread(target=load, args=(path,)) for path in 2 * sys.argv[1:]]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
print(faults)
"""


@pytest.mark.slow
def test_threads_that_load_the_first_net_of_a_fork_all_get_it(tmp_path: Path) -> None:
    texts = (
        'type: "Normalize" norm_param { across_spatial: false }',
        'type: "Interp" interp_param { zoom_factor: 2 }',
        'type: "ShuffleChannel" shuffle_channel_param { group: 2 }',
        'type: "Reverse" reverse_param { axis: 0 }',
    )
    paths = [tmp_path / f"{i}.prototxt" for i in range(len(texts))]
    for path, text in zip(paths, texts, strict=True):
        path.write_text(f'{INPUT} layer {{ name: "n" bottom: "x" top: "y" {text} }}')
    done = subprocess.run([sys.executable, "-c", FIRST, *paths], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
