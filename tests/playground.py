"""The folder in which the commands of the pages run: files under the names that the pages use, small enough for a test.

Images are those of the synthetic walk, in TUM's layout under the names of TUM's sequences; the nets are tiny, and the
nets of ``prototxt/`` are all there, with fewer iterations.
"""

import csv
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import torch

import documents
import places_layouts
from paths import GOLDEN, ROOT

FRAMES = 60
NET = """name: "tiny"
%s
layer {
  name: "conv1" type: "Convolution" bottom: "data" top: "conv1"
  convolution_param { num_output: 8 kernel_size: 5 stride: 4 bias_term: false weight_filler { type: "msra" } }
}
layer { name: "bn1" type: "BatchNorm" bottom: "conv1" top: "conv1" }
layer { name: "scale1" type: "Scale" bottom: "conv1" top: "conv1" scale_param { bias_term: true } }
layer { name: "relu1" type: "ReLU" bottom: "conv1" top: "conv1" }
layer { name: "pool1" type: "Pooling" bottom: "conv1" top: "pool1" pooling_param { pool: AVE global_pooling: true } }
layer {
  name: "feat" type: "InnerProduct" bottom: "pool1" top: "feat"
  inner_product_param { num_output: 4 weight_filler { type: "xavier" } }
}
%s
"""
DATA = (Path(__file__).parent / "nets" / "data.prototxt").read_text()
SOLVER = (Path(__file__).parent / "nets" / "solver.prototxt").read_text()
SCRIPT = (Path(__file__).parent / "programs" / "script.py").read_text()
INPUT = 'layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 1 dim: 3 dim: 32 dim: 32 } } }'
LOSS = 'layer { name: "loss" type: "SoftmaxWithLoss" bottom: "feat" bottom: "label" top: "loss" }'
PROB = 'layer { name: "prob" type: "Softmax" bottom: "feat" top: "prob" }'
# Sequences that the trained nets are trained on.
SEQUENCES = (
    "bridge_highway",
    "city_drive",
    "maker_lab_robot",
    "office_handheld_loop",
    "rc_turquoise_track",
    "rc_exhibition_hall",
    "rc_warehouse_dim",
)
# A training of the project's solvers takes two iterations.
LESS = (
    (r"^max_iter: \d+", "max_iter: 2"),
    (r"^stepsize: \d+", "stepsize: 1"),
    (r"^test_iter: \d+.*", "test_iter: 1"),
    (r"^test_interval: \d+", "test_interval: 2"),
    (r"^snapshot: \d+", "snapshot: 2"),
    (r"batch_size: (32|50|250|256)\b", "batch_size: 4"),
)


def make(folder: Path) -> Path:
    """Make the folder. Returns it."""
    folder.mkdir()
    (folder / "data").mkdir()
    (folder / "out").mkdir()
    (folder / "out" / "quickstart").symlink_to("..")
    _prototxts(folder)
    _sequences(folder)
    _net(folder)
    _layouts(folder)
    return folder


def quickstart(folder: Path) -> None:
    """Make what ``tools/quickstart`` leaves, with fewer images and without its results."""
    _run(
        folder,
        "lmdb-build walk walk --sequences 3 --frames 40 --size 160x120 --depth\n"
        "lmdb-build pairs walk/walk_1 walk/walk_2 walk/walk_3 --different-scenes --split sequence --train-sequences "
        "walk_1,walk_2 --val-sequences walk_3 --train 64 --val 16 --test 0 --min-gap 1 --out pairs\n"
        "for s in train val; do lmdb-build convert -resize_width 64 -resize_height 64 walk/ pairs/$s.txt "
        "data/pairs64_${s}_lmdb; done",
    )


def _run(folder: Path, text: str) -> None:
    log = folder / "log"
    for command in documents.commands(text, folder):
        status = documents.run(command, log)
        assert status == 0, f"{command.words}\n{log.read_text()}"
    log.unlink()


def _prototxts(folder: Path) -> None:
    for path in (ROOT / "prototxt").rglob("*.*"):
        copy = folder / path.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix != ".prototxt":
            copy.symlink_to(path)
            continue
        text = path.read_text()
        for pattern, less in LESS:
            text = re.sub(pattern, less, text, flags=re.MULTILINE)
        copy.write_text(text)


def _sequences(folder: Path) -> None:
    """Walks through two houses; databases of pairs of their images; a folder and a table of another data set."""
    _run(folder, f"lmdb-build walk walk --sequences 2 --frames {FRAMES} --size 160x120 --depth")
    tum = folder / "tum"
    tum.mkdir()
    for number, name in ((1, "rgbd_dataset_freiburg1_xyz"), (2, "rgbd_dataset_freiburg1_rpy")):
        (folder / "walk" / f"walk_{number}").rename(tum / name)
        (folder / name).symlink_to(tum / name)
    (folder / "walk").rmdir()
    first, second = sorted(tum.iterdir(), reverse=True)
    for name in ("FOLDER", "SEQUENCE", "photos"):
        (folder / name).symlink_to(first)
    (folder / "OTHER_IMAGES").mkdir()
    for image in sorted((second / "rgb").iterdir())[::3]:  # enough features for 2,000 words
        shutil.copy(image, folder / "OTHER_IMAGES")
    shutil.copy(first / "groundtruth.txt", folder / "odometry.txt")
    images = sorted((first / "rgb").iterdir())
    for name, image in (("a.png", images[0]), ("b.png", images[20])):
        shutil.copy(image, folder / name)
    samples = folder / "corridor_loop" / "samples"
    samples.mkdir(parents=True)
    for number, image in enumerate(images):
        shutil.copy(image, samples / f"{number}.png")
    apart = np.abs(np.subtract.outer(np.arange(FRAMES), np.arange(FRAMES)))
    cv2.imwrite(f"{samples}_GT.bmp", np.where(apart % (FRAMES // 3) < 2, 255, 0).astype(np.uint8))
    (folder / "train.txt").write_text("".join(f"{image}\n" for image in sorted((second / "rgb").iterdir())))

    source = folder / "src"
    source.mkdir()
    (source / "tum").symlink_to(tum)
    for name in SEQUENCES:
        (source / name).symlink_to(first / "rgb")
    tower = source / "ie_tower"
    tower.mkdir()
    with open(tower / "index.csv", "w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["image", "floor", "clip", "second"])
        for floor, clip in ((floor, clip) for floor in range(12) for clip in range(2)):
            for second in range(14):
                name = f"{floor}_{clip}_{second}.png"
                shutil.copy(images[(5 * floor + second + clip) % FRAMES], tower / name)
                table.writerow([name, floor, f"{floor}_{clip}", second])


def _net(folder: Path) -> None:
    """A tiny net, its solver, its data, its weights and the log of its training, under all the names of the pages."""
    for name, text in (
        ("train_val.prototxt", NET % (DATA, LOSS)),
        ("net.prototxt", NET % (DATA, LOSS)),
        ("a.prototxt", NET % (INPUT, PROB)),
        ("b.prototxt", NET.replace("num_output: 8", "num_output: 9") % (INPUT, PROB)),
        ("deploy.prototxt", NET % (INPUT, PROB)),
        ("solver.prototxt", SOLVER),
        ("script.py", SCRIPT),
    ):
        (folder / name).write_text(text)
    images = sorted((folder / "FOLDER" / "rgb").iterdir())[:12]
    (folder / "list.txt").write_text("".join(f"{image} {i % 4}\n" for i, image in enumerate(images)))
    _run(folder, "lmdb-build imageset -resize_width 256 -resize_height 256 / list.txt train_lmdb")
    log = folder / "train.log"
    (train,) = documents.commands("netspec train --solver solver.prototxt", folder)
    assert documents.run(train, log) == 0, log.read_text()
    shutil.copy(GOLDEN / "log" / "caffe_train.log", folder / "old_caffe.log")
    for name, iteration in (("x", 4), ("net", 4), ("face", 4), ("a", 2), ("b", 4)):
        shutil.copy(folder / f"x_iter_{iteration}.caffemodel", folder / f"{name}.caffemodel")
    for made in (*folder.glob("x_iter_*"), folder / "list.txt"):
        made.unlink()
    places = "prototxt/many_negatives/places"
    _run(
        folder,
        f"netspec extract --model {places}/deploy.prototxt --weights {places}/places.caffemodel "
        "--blob feat --images OTHER_IMAGES --out others.npz",
    )
    _run(folder, "loopclosure evaluate SEQUENCE --method thumbnails --out A")
    shutil.copytree(folder / "A", folder / "B")


def _layouts(folder: Path) -> None:
    """Sequences of other benchmarks, a bag, a video, and a net that torch saved."""
    import places_bags

    places_layouts.write_euroc(folder).rename(folder / "MH_01_easy")
    sequence = places_layouts.write_kitti(folder)
    poses = folder / "dataset" / "poses" / "07.txt"
    for name in ("00", "02"):
        shutil.copytree(sequence, sequence.with_name(name))
        shutil.copy(poses, poses.with_name(f"{name}.txt"))
    places_layouts.write_video(folder / "drive.mp4")
    (folder / "slam.txt").write_text(places_layouts.tum_rows(places_layouts.path()))
    places_layouts.write_benchmark(folder / "Nordland")
    places_bags.Bag(folder / "drive.bag", 1, topic="/cam0/image_raw", amcl=True)
    net = torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d(4), torch.nn.Flatten())
    torch.export.save(torch.export.export(net.eval(), (torch.rand(1, 3, 120, 160),)), folder / "net.pt2")
