"""Diagrams of nets: boxes, repeated blocks, settings, escaped names, and the formats of `netspec draw`."""

import re
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from netspec.cli import main
from netspec.errors import SpecError
from netspec.graph.options import BuildOptions
from netspec.inspect.draw.blocks import find_blocks
from netspec.inspect.draw.diagram import Diagram, diagram_of
from netspec.inspect.draw.dot import dot_of
from netspec.inspect.draw.graphviz import render
from netspec.proto.schema import TEST, TRAIN
from netspec.proto.text import parse_net, parse_net_text
from paths import last_parts, nets_as_found

PHASES = [TRAIN, TEST]
INPUT = 'layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 1 dim: 8 dim: 9 dim: 9 } } }\n'


def read(text: str) -> Diagram:
    return diagram_of(*parse_net_text(text, "net.prototxt"), PHASES)


def layer(name: str, kind: str, bottoms: str, top: str, more: str = "") -> str:
    reads = " ".join(f'bottom: "{bottom}"' for bottom in bottoms.split())
    return f'layer {{ name: "{name}" type: "{kind}" {reads} top: "{top}" {more} }}\n'


def conv(name: str, bottom: str, more: str = "") -> str:
    settings = "convolution_param { num_output: 8 kernel_size: 3 pad: 1 }"
    return layer(name, "Convolution", bottom, name, f"{settings} {more}")


def residual(blocks: int) -> str:
    text, last = INPUT, "data"
    for k in range(blocks):
        text += conv(f"a{k}", last) + layer(f"r{k}", "ReLU", f"a{k}", f"a{k}") + conv(f"b{k}", f"a{k}")
        text += layer(f"s{k}", "Eltwise", f"{last} b{k}", f"s{k}")
        last = f"s{k}"
    return text + layer("end", "Pooling", last, "end", "pooling_param { global_pooling: true pool: AVE }")


def svg_of(diagram: Diagram, unfolded: bool = False) -> ElementTree.Element:
    return ElementTree.fromstring(render(dot_of(diagram, unfolded), "svg"))


def boxes_in(svg: ElementTree.Element) -> list[int]:
    """Return which boxes of the diagram are drawn."""
    classes = [element.get("class", "") for element in svg.iter()]
    return sorted(int(number) for each in classes for number in re.findall(r"\blayer-(\d+)$", each))


def words_in(svg: ElementTree.Element) -> set[str]:
    return {(element.text or "").strip() for element in svg.iter("{http://www.w3.org/2000/svg}text")}


@pytest.mark.slow
@pytest.mark.parametrize("path", nets_as_found(), ids=last_parts)
def test_every_layer_of_published_nets_is_drawn(path: Path) -> None:
    options = BuildOptions(open_data=False, given_shapes={"pair_data": (8, 6, 224, 224)})
    diagram = diagram_of(*parse_net(path), PHASES, options)
    assert boxes_in(svg_of(diagram, unfolded=True)) == list(range(len(diagram.boxes)))


@pytest.mark.slow
def test_repeated_blocks_are_drawn_once_and_can_be_unfolded() -> None:
    diagram = read(residual(100))
    assert len(diagram.boxes) == 302
    (block,) = find_blocks(diagram)
    assert (block.length, block.copies) == (3, 100)
    folded, unfolded = svg_of(diagram), svg_of(diagram, unfolded=True)
    assert "100 × the same: a0 … a99" in words_in(folded)
    assert [len(boxes_in(each)) for each in (folded, unfolded)] == [2 + 3, 302]


def test_different_blocks_are_not_merged() -> None:
    text = residual(4).replace('name: "b2" type: "Convolution"', 'name: "b2" type: "Convolution" propagate_down: true')
    assert [(block.first, block.copies) for block in find_blocks(read(text))] == []
    seen = residual(6) + layer("peek", "ReLU", "a3", "peek")  # a blob inside the fourth block is used elsewhere
    assert [(block.first, block.copies) for block in find_blocks(read(seen))] == [(1, 3)]


def test_the_towers_of_a_siamese_net_are_drawn_in_parallel() -> None:
    param = 'param { name: "w" } param { name: "b" }'
    text = INPUT + layer("cut", "Slice", "data", "p", 'top: "q"')
    for name in "pq":
        text += conv(f"c{name}", name, param) + layer(f"r{name}", "ReLU", f"c{name}", f"c{name}")
    diagram = read(text + layer("loss", "EuclideanLoss", "cp cq", "loss"))
    assert [box.owner for box in diagram.boxes if box.type == "Convolution"] == ["", "cp"]
    plain = render(dot_of(diagram), "plain").decode()
    at = {name: (float(x), float(y)) for name, x, y in re.findall(r"^node (\w+) (\S+) (\S+)", plain, re.M)}
    assert at["cp"][1] == at["cq"][1]
    assert at["cp"][0] != at["cq"][0]
    assert any("weights of cp" in words for words in words_in(svg_of(diagram)))


def test_boxes_show_the_settings_of_layers() -> None:
    text = 'name: "small"\n' + INPUT + conv("c", "data") + layer("r", "ReLU", "c", "c")
    text += layer("hit", "Softmax", "c", "hit", "include { phase: TEST }")
    box = read(text).boxes[1]
    assert (box.shapes, box.weights, box.work) == (("1×8×9×9",), 8 * 8 * 9 + 8, 8 * 8 * 9 * 81)
    assert [attached.name for attached in box.attached] == ["r"]
    words = words_in(svg_of(read(text)))
    assert {"small", "Convolution 3×3, 8, pad 1", "ReLU · r", "1×8×9×9", "TEST"} <= words
    assert "46.7 k mult-adds · 584 weights" in words


def test_an_in_place_layer_on_a_shared_blob_has_its_own_box() -> None:
    text = INPUT + conv("c", "data") + layer("p", "Pooling", "c", "p", "pooling_param { kernel_size: 3 }")
    diagram = read(text + layer("r", "ReLU", "c", "c") + layer("q", "Sigmoid", "c", "q"))
    assert [box.name for box in diagram.boxes] == ["data", "c", "p", "r", "q"]
    assert diagram.reads == ((), ((0, 0),), ((1, 0),), ((1, 0),), ((3, 0),))


def test_a_net_that_cannot_be_built_is_drawn_without_shapes() -> None:
    diagram = read(conv("c", "data").replace("c", "c", 1) + conv("d", "c"))
    assert [box.name for box in diagram.boxes] == ["c", "d"]
    assert any('unknown bottom blob "data"' in str(fault) for fault in diagram.faults)
    assert boxes_in(svg_of(diagram)) == [0, 1]
    assert boxes_in(svg_of(read('name: "empty"'))) == []
    assert [box.name for box in read('layer { name: "s" type: "Silence" bottom: "no" }').boxes] == ["s"]


@pytest.mark.slow
def test_draw_writes_svg_html_and_png(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    net = tmp_path / "net.prototxt"
    net.write_text('name: "a <b> & \\"c\\""\n' + residual(3).replace('"a0"', '"</script>"'))
    for suffix in ("svg", "html", "png"):
        assert main(["draw", str(net), "--out", str(tmp_path / f"net.{suffix}")]) == 0
    said = capsys.readouterr()
    assert said.err == ""
    assert said.out.splitlines()[-1] == f'{tmp_path / "net.png"}: 14 layers of a <b> & "c"'
    svg = ElementTree.parse(tmp_path / "net.svg").getroot()
    picture = cv2.imread(str(tmp_path / "net.png"))
    assert picture is not None
    assert picture.shape[1] == pytest.approx(2 * float(svg.attrib["width"].removesuffix("pt")), abs=4)
    assert np.ptp(picture) > 100
    page = (tmp_path / "net.html").read_text()
    assert page.count("</script>") == 1
    assert not re.search(r"(src|href)=|@import|url\(", page)
    assert main(["draw", str(net), "--out", str(tmp_path / "net.gif")]) == 2
    assert main(["draw", str(tmp_path / "none.prototxt"), "--out", str(tmp_path / "net.svg")]) == 1


def test_a_solver_is_drawn_by_its_training_net(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("net.prototxt").write_text('name: "trained"\n' + residual(1))
    Path("solver.prototxt").write_text('net: "net.prototxt" base_lr: 1 lr_policy: "fixed"')
    assert main(["draw", "solver.prototxt", "--out", "net.svg"]) == 0
    assert "trained" in Path("net.svg").read_text()


def test_a_missing_graphviz_is_reported_with_advice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.which", lambda *words, **options: None)
    with pytest.raises(SpecError, match=r"^drawing a net needs Graphviz: pip install graphviz-pure$"):
        render("digraph {}", "svg")
