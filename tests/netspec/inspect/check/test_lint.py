"""``netspec lint``: each rule, comments that ignore it, the command, and the project's own nets."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from case_files import read_cases
from netspec.cli import main
from netspec.inspect.check.check import ON_META
from netspec.inspect.check.findings import RULES
from netspec.inspect.check.lint import Linted, lint_file
from netspec.proto.text import parse_net
from paths import ROOT

DUMMY = """layer { name: "d" type: "DummyData" top: "x" top: "t"
  dummy_data_param { shape { dim: 2 dim: 3 dim: 4 dim: 4 } shape { dim: 2 } } }
"""
FILLED = 'weight_filler { type: "xavier" }'
CONV = f"""layer {{ name: "c" type: "Convolution" bottom: "x" top: "c"
  convolution_param {{ num_output: 2 kernel_size: 1 {FILLED} }} }}
"""
NORM = """layer { name: "n" type: "BatchNorm" bottom: "c" top: "c" }
layer { name: "s" type: "Scale" bottom: "c" top: "c" }
"""
IP = f"""layer {{ name: "ip" type: "InnerProduct" bottom: "c" top: "f"
  inner_product_param {{ num_output: 5 {FILLED} }} }}
"""
LOSS = 'layer { name: "l" type: "SoftmaxWithLoss" bottom: "f" bottom: "t" top: "l" }\n'
SOUND = DUMMY + CONV + IP + LOSS
SOLVER = 'net: "net.prototxt"\nbase_lr: 1\nmax_iter: 100\nsnapshot: 50\nsnapshot_prefix: "s"\n'


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def lint(net: str, solver: str | None = None) -> Linted:
    Path("net.prototxt").write_text(net)
    if solver is not None:
        Path("solver.prototxt").write_text(SOLVER + solver)
    linted = lint_file("net.prototxt" if solver is None else "solver.prototxt")
    assert not linted.faults
    return linted


def found(net: str, solver: str | None = None) -> list[str]:
    return [f"{each.rule} {each.where.line}:{each.where.column}" for each in lint(net, solver).found]


def test_correct_nets_and_solvers_have_no_findings() -> None:
    assert found(SOUND) == []
    assert found(SOUND, 'lr_policy: "fixed"') == []
    assert found(DUMMY + CONV.replace("num_output", "bias_term: false num_output") + NORM + IP + LOSS) == []


CASES = read_cases("netspec/inspect/check/cases/rules.txt")


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_each_rule_for_nets_finds_its_mistake_and_is_ignored_by_comment(case: dict[str, str]) -> None:
    net, (name, place) = case["net"], case["found"].split()
    assert found(net) == [f"{name} {place}"]
    (first, *_) = lint(net).found
    with_comment = net.split("\n")
    with_comment.insert(int(place.split(":")[0]) - 1, f"# lint: ignore={name}")
    assert found("\n".join(with_comment)) == []
    assert first.rule in RULES
    assert ";" in first.message or "does not" in first.message


def test_transform_param_that_differs_between_phases_is_found() -> None:
    data = 'layer {{ name: "d" type: "Data" top: "x" top: "t" include {{ phase: {} }}\n  transform_param {{ {} }}\n'
    data += '  data_param {{ source: "nowhere" batch_size: 2 backend: LMDB }} }}\n'
    train = data.format("TRAIN", "mirror: true crop_size: 4 scale: 0.5 mean_value: 1 mean_value: 2 mean_value: 3")
    test = data.format("TEST", "crop_size: 4 scale: 0.25")
    linted = lint(train + test)
    assert [str(each) for each in linted.found] == [
        'net.prototxt:5:3: layer "d" (Data): mean_value is absent here, and 1 2 3 in line 1, where "x" of the '
        "other phase is read; use the same value in both [transform-differs]",
        'net.prototxt:5:34: layer "d" (Data): scale is 0.25 here, and 0.5 in line 1, where "x" of the other phase is '
        "read; use the same value in both [transform-differs]",
    ]
    assert len(linted.unknown) == 1  # three means tell the channels


def test_a_net_of_one_phase_is_checked_in_that_phase() -> None:
    assert found(DUMMY.replace('top: "t"', 'top: "t" include { phase: TRAIN }') + CONV + IP + LOSS) == []


OF_SOLVERS = {
    "step_at_the_end": ('lr_policy: "step" stepsize: 100 gamma: 0.1', ["step-after-end 6:19"]),
    "step_before_the_end": ('lr_policy: "step" stepsize: 99 gamma: 0.1', []),
    "multistep_at_the_end": ('lr_policy: "multistep" stepvalue: 9 stepvalue: 100 gamma: 0.1', ["step-after-end 6:37"]),
    "no_effect": ('lr_policy: "fixed" gamma: 1', ["no-effect 6:20"]),
    "test_after_the_end": ('lr_policy: "fixed" test_iter: 1 test_interval: 101', ["test-after-end 6:33"]),
    "comment_at_the_wrong_line": ('lr_policy: "fixed" # lint: ignore=no-effect\ngamma: 1', ["no-effect 7:1"]),
    "comment_of_another_rule": ('lr_policy: "fixed"\ngamma: 1  # lint: ignore=other, no-effect', ["unknown-rule 7:11"]),
    "comment_above": ('lr_policy: "fixed"\n# why\n# lint: ignore=no-effect\n\ngamma: 1', []),
}


@pytest.mark.parametrize(("settings", "lines"), OF_SOLVERS.values(), ids=OF_SOLVERS)
def test_each_rule_for_solvers_finds_its_mistake_and_is_ignored_by_comment(settings: str, lines: list[str]) -> None:
    assert found(SOUND, settings) == lines


def test_findings_of_a_whole_file_are_ignored_on_its_first_line() -> None:
    def said(first: str) -> list[str]:
        Path("net.prototxt").write_text(SOUND)
        text = SOLVER.replace("snapshot: 50", "snapshot_after_train: false") + 'lr_policy: "fixed"'
        Path("solver.prototxt").write_text(first + text)
        return [each.rule for each in lint_file("solver.prototxt").found]

    assert said("") == ["no-snapshot"]
    assert said("# About it.\n# lint: ignore=no-snapshot\n") == []


def test_a_layer_that_is_tested_with_random_weights_is_found() -> None:
    extra = IP.replace('"ip"', '"other"').replace('top: "f"', 'top: "g" include { phase: TEST }')
    extra += 'layer { name: "a" type: "Accuracy" bottom: "g" bottom: "t" top: "a" include { phase: TEST } }\n'
    settings = 'lr_policy: "fixed" test_iter: 1 test_interval: 10'
    assert found(SOUND + extra, settings) == ["untrained-in-test 8:1"]
    assert found(SOUND.replace('"ip"', '"other"') + extra.replace("other", "ip"), settings) == ["untrained-in-test 8:1"]


def test_rules_that_need_no_shapes_are_applied_without_them() -> None:
    data = (
        'layer { name: "d" type: "Data" top: "x" top: "t" data_param { source: "no" batch_size: 2 backend: LMDB } }\n'
    )
    linted = lint(data + CONV + NORM + IP + LOSS)
    assert [each.rule for each in linted.found] == ["bias-before-batchnorm"]
    assert "give --shape x=2,C,H,W" in str(linted.unknown[0])


def test_every_rule_has_a_reason() -> None:
    for rule in RULES.values():
        assert rule.reason.endswith("."), rule.name


def test_lint_has_status_0_1_or_2(capsys: pytest.CaptureFixture[str]) -> None:
    Path("good.prototxt").write_text(SOUND)
    Path("net.prototxt").write_text(DUMMY + CONV + NORM + IP + LOSS)
    assert main(["lint", "good.prototxt"]) == 0
    assert main(["lint", "good.prototxt", "net.prototxt"]) == 1
    said = (
        'net.prototxt:4:3: layer "c" (Convolution): its bias is subtracted again by BatchNorm "n"; set bias_term: false'
    )
    assert capsys.readouterr() == (f"{said} [bias-before-batchnorm]\n", "")
    Path("faulty.prototxt").write_text(SOUND.replace('bottom: "c"', 'bottom: "cc"'))
    assert main(["lint", "faulty.prototxt"]) == 1
    assert 'unknown bottom blob "cc"' in capsys.readouterr().out
    Path("bad.prototxt").write_text("layer {")
    assert main(["lint", "bad.prototxt", "none.prototxt", "good.prototxt"]) == 2
    out, err = capsys.readouterr()
    assert (out, len(err.splitlines())) == ("", 2)
    assert main(["lint", "--rules"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == len(RULES)
    assert main(["lint"]) == 2


def test_errors_and_findings_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    Path("net.prototxt").write_text(DUMMY + CONV + NORM + IP + LOSS)
    Path("faulty.prototxt").write_text(SOUND.replace('bottom: "c"', 'bottom: "cc"'))
    assert main(["lint", "--json", "net.prototxt", "faulty.prototxt"]) == 1
    found, faulty = map(json.loads, capsys.readouterr().out.splitlines())
    place = {"file": "net.prototxt", "line": 4, "column": 3, "layer": "c", "type": "Convolution"}
    message = 'its bias is subtracted again by BatchNorm "n"; set bias_term: false'
    rule = "bias-before-batchnorm"
    assert found == {
        "file": "net.prototxt", "faults": [], "warnings": [{**place, "message": message, "rule": rule}]
    }  # fmt: skip
    assert [(each["line"], each["layer"]) for each in faulty["faults"]] == [(5, "ip")]
    assert main(["check", "--json", "faulty.prototxt"]) == 1
    out, err = capsys.readouterr()
    assert json.loads(out)["faults"] == faulty["faults"]
    assert "\nfaulty.prototxt:5:41: " in err
    Path("bad.prototxt").write_text("layer {")
    assert main(["check", "--json", "bad.prototxt"]) == 1
    (fault,) = json.loads(capsys.readouterr().out)["faults"]
    assert (fault["line"], fault["column"]) == (1, 8)


def pair_shape(path: Path) -> dict[str, tuple[int, ...]]:
    nets = [*path.parent.glob("train_val*.prototxt"), path]
    layers = [layer for net in nets for layer in parse_net(net)[0].layer if layer.data_param.batch_size]
    return {"pair_data": (layers[0].data_param.batch_size, 6, 128, 128)}


@pytest.mark.slow
@pytest.mark.parametrize(
    "path",
    [path for path in sorted((ROOT / "prototxt").rglob("*.prototxt")) if "solver" not in path.name],
    ids=lambda path: "/".join(path.parts[-3:]),
)
def test_the_projects_nets_have_no_findings(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    shapes = pair_shape(path) if "train" in path.name else {}
    linted = lint_file(path.relative_to(ROOT), replace(ON_META, given_shapes=shapes))
    assert [*map(str, linted.found), *map(str, linted.faults)] == []
    assert linted.readable


@pytest.mark.slow
@pytest.mark.parametrize(
    "path", sorted((ROOT / "prototxt").rglob("solver*.prototxt")), ids=lambda path: "/".join(path.parts[-3:])
)
def test_the_projects_solvers_have_no_findings(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    linted = lint_file(path.relative_to(ROOT))
    assert [*map(str, linted.found), *map(str, linted.faults)] == []
