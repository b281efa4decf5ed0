"""What must hold of every picture, checked on the coordinates of its marks."""

from collections.abc import Iterator
from itertools import pairwise, takewhile

from netspec.inspect.draw.marks import Curve, Rect, Text
from netspec.inspect.draw.picture import Drawing, Picture

Area = tuple[float, float, float, float]  # left, top, right, bottom
LEAST_TEXT = 9  # pixels
SCREEN = 1280


def faults(picture: Picture, unfolded: bool = False) -> Iterator[str]:
    """Yield what overlaps, leaves the picture, or is too small to read."""
    drawing = picture.marks(unfolded)
    boxes = {f"box {mark.layer}": area(mark) for mark in drawing.marks if isinstance(mark, Rect) and mark.layer >= 0}
    texts = {f"text {k} {mark.text!r}": area(mark) for k, mark in enumerate(texts_of(drawing))}
    placed = sorted({**boxes, **texts}.items(), key=lambda item: item[1][1])
    for i, (one, a) in enumerate(placed):
        for other, b in takewhile(lambda item, bottom=a[3]: item[1][1] < bottom, placed[i + 1 :]):
            inside = one.startswith("box") != other.startswith("box") and (within(a, b) or within(b, a))
            if overlap(a, b) and not inside:
                yield f"{one} and {other} overlap"
    for name, (left, top, right, bottom) in {**boxes, **texts}.items():
        if left < 0 or top < 0 or right > picture.width or bottom > drawing.height:
            yield f"{name} leaves the picture"
    for curve in (mark for mark in drawing.marks if isinstance(mark, Curve)):
        points = list(along(curve))
        for name, place in near({**boxes, **texts}, points):
            if any(overlap((x, y, x, y), place) for x, y in points):
                yield f"a wire from {curve.points[0]} to {curve.points[-1]} crosses {name}"
    for text in texts_of(drawing):
        if text.size < LEAST_TEXT:
            yield f"{text.text!r} is small"


def texts_of(drawing: Drawing) -> list[Text]:
    return [mark for mark in drawing.marks if isinstance(mark, Text) and mark.text]


def near(places: dict[str, Area], points: list[tuple[float, float]]) -> Iterator[tuple[str, Area]]:
    top, bottom = min(y for _, y in points), max(y for _, y in points)
    return ((name, place) for name, place in places.items() if place[1] < bottom and place[3] > top)


def area(mark: Rect | Text) -> Area:
    if isinstance(mark, Rect):
        return mark.x, mark.y, mark.x + mark.width, mark.y + mark.height
    return mark.x, mark.y - 0.8 * mark.size, mark.x + mark.width, mark.y + 0.2 * mark.size


def overlap(a: Area, b: Area) -> bool:
    slack = 0.1
    return a[0] < b[2] - slack and b[0] < a[2] - slack and a[1] < b[3] - slack and b[1] < a[3] - slack


def within(a: Area, b: Area) -> bool:
    return b[0] <= a[0] and b[1] <= a[1] and a[2] <= b[2] and a[3] <= b[3]


def along(curve: Curve) -> Iterator[tuple[float, float]]:
    """Yield points of a curve, at most a few pixels apart."""
    steps = 60
    straight = curve.points
    if curve.bent:
        p = curve.points[:4]
        for k in range(steps + 1):
            t = k / steps
            weights = ((1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t * t * (1 - t), t**3)
            yield (
                sum(w * x for w, (x, _) in zip(weights, p, strict=True)),
                sum(w * y for w, (_, y) in zip(weights, p, strict=True)),
            )
        straight = curve.points[3:]
    for (x1, y1), (x2, y2) in pairwise(straight):
        count = max(2, int((abs(x2 - x1) + abs(y2 - y1)) / 4))
        yield from ((x1 + (x2 - x1) * k / count, y1 + (y2 - y1) * k / count) for k in range(count + 1))
