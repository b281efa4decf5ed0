"""A process that runs one net with one program on request: ``python -m benchmarks.worker TASK``.

TASK is JSON: ``program`` is one of PROGRAMS, the other keys are its settings. The process answers with lines of JSON on
stdout: first {} or {"fault": ...}; then, for each line with a number n on stdin, the times of n passes, after one pass
that is not counted. The times of a pass are the wall-clock seconds and the CPU seconds of all threads. Every program
imports its own library, because the environment may not have the others.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from typing import Any

import numpy as np

Task = dict[str, Any]
Run = Callable[[], dict[str, Any]]  # a pass; returns its outputs by blob


def netspec(task: Task) -> Run:
    """Run netspec with the engine of the task, or the default one, as a program that imports netspec does."""
    netspec = import_module("netspec")  # before torch: it sets how OpenMP's threads wait
    import torch

    torch.set_num_threads(task["threads"])
    chosen = {name: task[name] for name in ("engine", "precision", "cache")}
    net = netspec.load_net(task["prototxt"], "TEST", task["caffemodel"], **chosen)
    inputs = _inputs(task)

    def run() -> dict[str, Any]:
        with torch.inference_mode():
            return net(**inputs)

    return run


def pycaffe(task: Task) -> Run:
    """Run netspec's pycaffe."""
    os.environ.setdefault("GLOG_minloglevel", "2")
    caffe = import_module("netspec.pycaffe")
    import torch

    torch.set_num_threads(task["threads"])
    net = caffe.Net(task["prototxt"], task["caffemodel"], caffe.TEST)
    for name, value in _inputs(task).items():
        net.blobs[name].data[...] = value
    return net.forward


def pytorch(task: Task) -> Run:
    """Run the exported module. netspec sets how OpenMP waits, and is not imported here."""
    import torch

    torch.set_num_threads(task["threads"])
    net = exported(task["torch"])
    inputs = {name: torch.from_numpy(value) for name, value in _inputs(task).items()}

    def run() -> dict[str, Any]:
        with torch.inference_mode():
            found = net(**inputs)
        return found if isinstance(found, dict) else {task["outputs"][0]: found}

    return run


def exported(path: str) -> Any:
    """Return the net, with its weights, of a module that ``netspec export --to torch`` wrote."""
    spec = spec_from_file_location("exported", path)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.load()


def parameter_groups(net: Any, rate: float, decay: float) -> list[dict[str, Any]]:
    """Return the parameter groups for torch.optim: biases have twice the learning rate and no weight decay."""
    import torch

    groups = []
    for module in net.modules():
        normalizes = isinstance(module, torch.nn.BatchNorm2d)
        for name, blob in module.named_parameters(recurse=False):
            fast = name == "bias" and not normalizes
            weighs = name != "bias" and not normalizes
            groups.append({"params": [blob], "lr": rate * (1 + fast), "weight_decay": decay if weighs else 0})
    return groups


def opencv4(task: Task) -> Run:
    """Run OpenCV 4's importer."""
    import cv2

    cv2.setNumThreads(task["threads"])
    net = cv2.dnn.readNetFromCaffe(task["prototxt"], task["caffemodel"])  # type: ignore[attr-defined]
    inputs, outputs = _inputs(task), task["outputs"]

    def run() -> dict[str, Any]:
        for name, value in inputs.items():
            net.setInput(value, name)
        return dict(zip(outputs, net.forward(outputs), strict=True))

    return run


def onnxruntime(task: Task) -> Run:
    """Run the exported model in onnxruntime directly."""
    os.environ["ORT_DISABLE_TELEMETRY"] = "1"  # it would look up a host
    import onnxruntime as ort

    options = ort.SessionOptions()
    options.intra_op_num_threads = task["threads"]
    options.log_severity_level = 3
    session = ort.InferenceSession(task["onnx"], options, providers=["CPUExecutionProvider"])
    inputs, outputs = _inputs(task), task["outputs"]
    return lambda: dict(zip(outputs, session.run(outputs, inputs), strict=True))


def openvino(task: Task) -> Run:
    """Run the exported model in OpenVINO directly, in the precision of the task."""
    sys.modules["openvino_telemetry"] = None  # type: ignore[assignment]  # it would look up a host
    import openvino

    core = openvino.Core()
    model = core.read_model(task["onnx"])
    inputs, outputs = _inputs(task), task["outputs"]
    model.reshape({name: list(value.shape) for name, value in inputs.items()})
    settings = {
        "INFERENCE_PRECISION_HINT": {"fp32": "f32", "bf16": "bf16"}[task.get("precision", "fp32")],
        "INFERENCE_NUM_THREADS": task["threads"],
        "PERFORMANCE_HINT": "LATENCY",
    }
    request = core.compile_model(model, "CPU", settings).create_infer_request()

    def run() -> dict[str, Any]:
        found = request.infer(inputs)
        return {name: found[name] for name in outputs}

    return run


def netspec_training(task: Task) -> Run:
    """Train as ``netspec train`` does: its data layer, its solver."""
    import_module("netspec.terminal.process").set_up()  # before torch: it sets how OpenMP's threads wait
    import torch

    import netspec
    from netspec.terminal.process import keep_freed_memory

    keep_freed_memory()
    torch.set_num_threads(task["threads"])
    solver = netspec.load_solver(
        task["solver"], task["caffemodel"], device=task["device"], precision=task.get("precision", "fp32")
    )

    def run() -> dict[str, Any]:
        solver.step(1)
        _finish(task)
        return {"loss": solver.loss}

    return run


def pycaffe_training(task: Task) -> Run:
    """Train with the solver of netspec's pycaffe."""
    os.environ.setdefault("GLOG_minloglevel", "2")
    caffe = import_module("netspec.pycaffe")
    import torch

    torch.set_num_threads(task["threads"])
    solver = caffe.get_solver(task["solver"])
    solver.net.copy_from(task["caffemodel"])

    def run() -> dict[str, Any]:
        solver.step(1)
        return {"loss": solver.net.blobs["loss"].data.copy()}

    return run


def pytorch_training(task: Task) -> Run:
    """Train the exported module by SGD on a batch in memory; in bf16 by autocast."""
    import torch

    torch.set_num_threads(task["threads"])
    torch.backends.cudnn.allow_tf32 = False  # as in netspec
    net = exported(task["torch"]).train().to(task["device"])
    groups = parameter_groups(net, task["rate"], task["decay"])
    optimizer = torch.optim.SGD(groups, lr=task["rate"], momentum=task["momentum"])
    data, labels = (torch.from_numpy(value).to(task["device"]) for value in _inputs(task).values())
    kind = torch.device(task["device"]).type

    def run() -> dict[str, Any]:
        optimizer.zero_grad()
        with torch.autocast(kind, torch.bfloat16) if task["precision"] == "bf16" else nullcontext():
            loss = net(data, labels)
        loss.backward()
        optimizer.step()
        _finish(task)
        return {"loss": loss.detach().float().cpu()}

    return run


PROGRAMS: dict[str, Callable[[Task], Run]] = {
    program.__name__: program
    for program in (
        netspec,
        pycaffe,
        pytorch,
        opencv4,
        onnxruntime,
        openvino,
        netspec_training,
        pycaffe_training,
        pytorch_training,
    )
}


def _finish(task: Task) -> None:
    """Wait until a GPU has finished."""
    import torch

    if torch.device(task["device"]).type == "cuda":
        torch.cuda.synchronize(task["device"])


def _inputs(task: Task) -> dict[str, np.ndarray]:
    with np.load(task["inputs"]) as arrays:
        return {name: arrays[name] for name in arrays.files}


def main(programs: Mapping[str, Callable[[Task], Run]] = PROGRAMS) -> None:
    """Answer requests until stdin ends."""
    task = json.loads(sys.argv[1])
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # output of libraries goes to stderr
    try:
        run = programs[task["program"]](task)
        np.savez(task["result"], allow_pickle=False, **{name: np.array(value) for name, value in run().items()})
    except Exception as fault:
        print(json.dumps({"fault": f"{type(fault).__name__}: {' '.join(str(fault).split())}"}), file=answers)
        return
    print(json.dumps({}), file=answers)
    for line in sys.stdin:
        run()
        passes = []
        for _ in range(int(line)):
            began = time.perf_counter(), time.process_time()
            run()
            passes.append((time.perf_counter() - began[0], time.process_time() - began[1]))
        print(json.dumps(passes), file=answers)


if __name__ == "__main__":
    main()
