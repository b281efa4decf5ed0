"""The paper's nets: towers and variants agree, deploy files fit, and the full files train one iteration as they are."""

import itertools
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import netspec
from netspec.data.database import Writer
from netspec.data.datum import array_to_datum
from netspec.inspect.check.check import check_file
from netspec.layers import layer_class
from netspec.load import load_net
from netspec.net.weights import load_weights, save_weights
from netspec.proto.schema import TEST, LayerParameter
from netspec.proto.text import parse_net_text, read_net, read_solver
from paths import ROOT

NETS = ("siamese_8", "siamese_128", "siamese_resnet27_256", "siamese_resnet27_512")
PARTS = ("", "normalized", "small")
FOLDERS = [ROOT / "prototxt" / part / name for part in PARTS for name in NETS]
SIDES = {"small": 64}


def side(folder: Path) -> int:
    return SIDES.get(folder.parent.name, 224)


def bring_here(folder: Path, batch: int, seed: int = 1) -> None:
    """Write net.prototxt and solver.prototxt for a database ``pairs`` in the present folder."""
    text = (folder / "train_val.prototxt").read_text()
    text = re.sub(r'source: "[^"]*"', 'source: "pairs"', text)
    text, count = re.subn(r"batch_size: \d+", f"batch_size: {batch}", text)
    assert count == 2
    parse_net_text(text, "net")
    Path("net.prototxt").write_text(text)
    solver = (folder / "solver.prototxt").read_text()
    solver = re.sub(r'net: "[^"]*"', 'net: "net.prototxt"', solver)
    solver = re.sub(r'snapshot_prefix: "[^"]*"', 'snapshot_prefix: "x"', solver)
    solver = re.sub(r"random_seed: \d+", f"random_seed: {seed}", solver)
    solver = re.sub(r"test_initialization: false", "", solver)
    Path("solver.prototxt").write_text(solver + "test_initialization: false\n")


def layers_of(path: Path) -> dict[str, LayerParameter]:
    return {layer.name: layer for layer in read_net(path).layer}


@pytest.mark.slow
@pytest.mark.parametrize("folder", FOLDERS, ids=lambda path: f"{path.parent.name}-{path.name}")
def test_the_towers_differ_only_in_names(folder: Path) -> None:
    net = read_net(folder / "train_val.prototxt")
    second = [layer for layer in net.layer if layer.name.endswith("_p")]
    first = [layer for layer in net.layer if layer.type not in ("Data", "Slice", "ContrastiveLoss")][: len(second)]
    assert len(first) == len(second) > 5
    for mine, twin in zip(first, second, strict=True):
        assert [p.name for p in mine.param] == [p.name for p in twin.param]
        assert all(p.name for p in mine.param)
        for field in ("bottom", "top"):
            assert [f"{blob}_p" for blob in getattr(mine, field)] == list(getattr(twin, field))
        assert mine.name + "_p" == twin.name
        twin.name = mine.name
        for field in ("bottom", "top"):
            del getattr(twin, field)[:]
            getattr(twin, field).extend(getattr(mine, field))
        assert mine == twin


@pytest.mark.slow
@pytest.mark.parametrize("folder", FOLDERS, ids=lambda path: f"{path.parent.name}-{path.name}")
def test_deploy_is_the_first_tower(folder: Path) -> None:
    train = layers_of(folder / "train_val.prototxt")
    deploy = read_net(folder / "deploy.prototxt")
    assert list(deploy.layer[0].input_param.shape[0].dim) == [1, 3, side(folder), side(folder)]
    assert len(deploy.layer) > 5
    for layer in deploy.layer[1:]:
        assert layer == train[layer.name]
    assert deploy.layer[-1].top[0] == "feat"


def test_nets_of_one_kind_differ_only_in_the_last_layer() -> None:
    for part in PARTS:
        for one, other in (("siamese_8", "siamese_128"), ("siamese_resnet27_256", "siamese_resnet27_512")):
            texts = [(ROOT / f"prototxt/{part}/{name}/train_val.prototxt").read_text() for name in (one, other)]
            changed = [pair for pair in zip(*(t.splitlines() for t in texts), strict=True) if pair[0] != pair[1]]
            of_last = [pair for pair in changed if "num_output:" in pair[0]]
            assert len(of_last) == 2  # one per tower
            assert all(line.startswith(("#", "name:")) for pair in changed if pair not in of_last for line in pair)


def test_the_residual_net_has_27_convolutions_and_7x7x512_reach_the_features() -> None:
    (checked,) = check_file(ROOT / "prototxt/siamese_resnet27_256/deploy.prototxt", TEST)
    assert checked.net is not None
    kinds = [layer.type for layer in checked.net.param.layer]
    assert kinds.count("Convolution") == kinds.count("BatchNorm") == 27
    assert kinds.count("Scale") == 27
    assert kinds.count("Eltwise") == 1 + 2 + 5 + 3
    (last,) = (node for node in checked.net.plan.nodes if node.type == "InnerProduct")
    assert checked.net.shapes[checked.net.plan.blobs[last.bottoms[0]]] == (1, 512, 7, 7)


def test_the_nets_have_the_papers_layers() -> None:
    """It names no normalization: the last InnerProducts go straight into the loss, and nothing else follows them."""
    for name in NETS:
        layers = layers_of(ROOT / f"prototxt/{name}/train_val.prototxt")
        assert [layers[last].type for last in ("feat", "feat_p")] == ["InnerProduct", "InnerProduct"]
        assert list(layers["loss"].bottom) == ["feat", "feat_p", "sim"]
        assert "Reduction" not in {layer.type for layer in layers.values()}


@pytest.mark.parametrize("name", NETS)
def test_normalized_nets_add_a_normalization_to_the_papers_nets(name: str) -> None:
    paper, longer = (layers_of(ROOT / f"prototxt/{part}/{name}/train_val.prototxt") for part in ("", "normalized"))
    added = {f"{layer}{side}" for layer in ("ip_feat", "feat_sumsq", "feat_inverse") for side in ("", "_p")}
    assert longer.keys() - paper.keys() == added
    for layer in paper.keys() - {"feat", "feat_p"}:
        assert paper[layer] == longer[layer]
    for side in ("", "_p"):
        assert paper[f"feat{side}"].inner_product_param == longer[f"ip_feat{side}"].inner_product_param


@pytest.mark.slow
@pytest.mark.parametrize(("name", "seed"), [("siamese_128", 1), ("siamese_128", 3), ("siamese_resnet27_256", 3)])
def test_training_works_for_any_seed(name: str, seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Features that are all alike have a loss of 0.25; a training that diverges leaves it far behind."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    places = [cv2.resize(rng.integers(0, 256, (5, 5, 3), np.uint8), (64, 64)) for _ in range(5)]
    with Writer("pairs") as writer:
        for k in range(8):
            pair = np.dstack([places[k % 5], places[k % 5 if k < 4 else (k + 1) % 5]]).astype(int)
            noisy = np.clip(pair + rng.normal(0, 20, pair.shape), 0, 255).astype(np.uint8)
            writer.put(b"%08d" % k, array_to_datum(noisy.transpose(2, 0, 1), int(k < 4)).SerializeToString())
    bring_here(ROOT / "prototxt/small" / name, batch=8, seed=seed)
    trained = netspec.load_solver("solver.prototxt", device="cpu")
    losses = []
    for _ in range(5):
        trained.step(1)
        losses.append(trained.loss)
    trained.close()
    assert max(losses) < 0.5


def test_the_solvers_have_the_papers_settings() -> None:
    for part, name in itertools.product(("", "normalized"), NETS):
        solver = read_solver(ROOT / f"prototxt/{part}/{name}/solver.prototxt")
        assert Path(solver.net) == Path("prototxt") / part / name / "train_val.prototxt"
        assert (solver.lr_policy, solver.stepsize, solver.max_iter, solver.type) == ("step", 10000, 30000, "SGD")
        assert [round(v, 6) for v in (solver.base_lr, solver.gamma, solver.momentum)] == [0.01, 0.1, 0.9]
        small = read_solver(ROOT / f"prototxt/small/{name}/solver.prototxt")
        assert 3 * small.stepsize == small.max_iter
        assert small.solver_mode == small.CPU  # the first training that one tries warns of nothing


@pytest.mark.slow
# One of each kind: the others differ in their last layer alone, or in the size of their images.
@pytest.mark.parametrize("folder", [FOLDERS[k] for k in (0, 8, 11)], ids=lambda path: f"{path.parent.name}-{path.name}")
def test_weights_of_one_iteration_load_into_the_deploy_net(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    with Writer("pairs") as writer:
        for k in range(4):
            pixels = rng.integers(0, 256, (6, side(folder), side(folder)), dtype=np.uint8)
            writer.put(b"%08d" % k, array_to_datum(pixels, k % 2).SerializeToString())
    bring_here(folder, batch=2)
    trained = netspec.load_solver("solver.prototxt", device="cpu")
    last = "ip_feat" if "ip_feat" in trained.net.params else "feat"
    before = trained.net.params[last][0].detach().clone()
    trained.step(1)
    assert np.isfinite(trained.loss)
    assert not np.array_equal(before.numpy(), trained.net.params[last][0].detach().numpy())
    save_weights(trained.net, "x.caffemodel")
    trained.close()
    deploy = load_net(folder / "deploy.prototxt")
    load_weights(deploy, "x.caffemodel")
    for name, blobs in deploy.params.items():
        for mine, theirs in zip(blobs, trained.net.params[name], strict=True):
            assert np.array_equal(mine.detach().numpy(), theirs.detach().numpy())


WORDS = ROOT / "prototxt" / "many_negatives" / "siamese_words_256"
PLACES = ROOT / "prototxt" / "many_negatives" / "places"


@pytest.mark.slow
def test_the_words_loss_is_the_softmax_loss_of_a_batchs_cosines_both_ways(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    with Writer("pairs") as writer:
        for k in range(48):
            pixels = rng.integers(0, 256, (6, 48, 64), dtype=np.uint8)
            writer.put(b"%08d" % k, array_to_datum(pixels, 1).SerializeToString())
    text = re.sub(r'source: "[^"]*"', 'source: "pairs"', (WORDS / "train_val.prototxt").read_text())
    Path("net.prototxt").write_text(text)
    net = load_net("net.prototxt", phase="TRAIN", seed=0)
    net.keep = "all"
    loss, _ = net.forward_loss()
    expected = 0.0
    for kind in ("whole", "parts"):
        first, second = (net.blobs[name].detach().double() for name in (kind, f"{kind}_p"))
        np.testing.assert_allclose(first.square().sum(1), 1, rtol=1e-4)
        cosines, own = 15 * first @ second.T, torch.arange(48)
        both_ways = [torch.nn.functional.cross_entropy(scores, own).item() for scores in (cosines, cosines.T)]
        expected += np.mean(both_ways)
    np.testing.assert_allclose(loss.item(), expected, rtol=1e-4)
    loss.backward()
    for name in ("conv1", "res6b", "words", "layout"):
        grad = net.params[name][0].grad
        assert grad is not None, name
        assert grad.abs().max() > 0, name


def test_the_words_net_and_its_deploy_net_have_two_equal_towers() -> None:
    train, deploy = (layers_of(WORDS / f"{name}.prototxt") for name in ("train_val", "deploy"))
    names = [name for name, layer in train.items() if layer.param and not name.endswith("_p")]
    assert len(names) == 3 * 9 + 2
    for name in names:
        assert [p.name for p in train[name].param] == [p.name for p in train[f"{name}_p"].param]
        assert all(p.name for p in train[name].param)
        if name not in ("bn_flat_whole", "bn_flat_parts"):  # they center the descriptors in training alone
            assert deploy[name] == train[name]
    (checked,) = check_file(WORDS / "deploy.prototxt", TEST)
    assert checked.net is not None
    shapes = {name: checked.net.shapes[name] for name in checked.net.plan.outputs}
    assert shapes == {"feat": (1, 256 + 25 * 64)}


def test_places_contains_the_net_of_256_words_and_only_caffes_layers() -> None:
    small, large = (layers_of(folder / "deploy.prototxt") for folder in (WORDS, PLACES))
    for name in small.keys() - {"data", "input", "feat"}:
        assert large[name] == small[name]
    assert small["input"].mvn_param == large["input"].mvn_param
    own, theirs = (load_net(f / "deploy.prototxt", weights=f / f"{f.name}.caffemodel").params for f in (PLACES, WORDS))
    for name in ("conv1", "res6b", "words", "layout"):
        assert own[name][0].shape == theirs[name][0].shape  # they have learned further
    assert all(layer_class(layer.type).__module__.startswith("netspec.layers.") for layer in large.values())
