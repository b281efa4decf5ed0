"""Sources of pairs from files: masks of loops, lists of the images of a place, folders with equal names."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lmdb_build.pairs.choose import LEFT_OUT, NEGATIVE, POSITIVE, Indices, PairSource
from loopclosure.errors import InputError
from loopclosure.places import masks
from loopclosure.places.frames import image_paths
from loopclosure.places.masks import read_matches, read_truth_matrix


class MaskSource(PairSource):
    """One run of images and a mask of loops, as of the FAB-MAP sets."""

    def __init__(self, mask: Path, images: Path, root: Path, min_gap: int | None = None, camera: str = "all") -> None:
        """Read the mask (Q, Q) and the Q images of a folder, in natural order.

        A mask does not mark neighbors in time, although they show the same place. So pairs with a gap of less than
        ``min_gap`` images are left out; the default is the smallest gap of a marked pair. Soft entries of the mask are
        left out too. ``camera`` selects images: see loopclosure.places.masks.images_of_places.
        """
        hard, soft = read_truth_matrix(mask)
        paths = image_paths(images)
        places = masks.images_of_places(camera, len(paths))
        hard, soft = (masks.mask_of_places(camera, matrix, len(paths), mask) for matrix in (hard, soft))
        self._judged = masks.comparable(camera, places)
        self._hard, self._soft = (hard | hard.T) & self._judged, soft | soft.T
        self.names = [relative(paths[image], root) for image in places]
        count = len(self.names)
        self.tracks = self.groups = np.zeros(count, np.intp)
        self.group_names = [images.name]
        self.stamps = np.arange(count, dtype=np.float64)
        marked = np.argwhere(np.triu(self._hard, 1))
        if not len(marked):
            raise InputError("marks no loop", mask)
        self._min_gap = int((marked[:, 1] - marked[:, 0]).min()) if min_gap is None else min_gap
        self._marked = marked
        self.settings = {
            "source": f"mask {mask.name} of {images.name}, camera {camera}",
            "least gap": f"{self._min_gap} images",
        }

    def judge(self, first: Indices, second: Indices) -> NDArray[np.int8]:
        """Label pairs (N,) by the mask."""
        labels = np.where(self._hard[first, second], POSITIVE, NEGATIVE).astype(np.int8)
        labels[self._soft[first, second] & ~self._hard[first, second]] = LEFT_OUT
        labels[np.abs(self.stamps[first] - self.stamps[second]) < self._min_gap] = LEFT_OUT
        labels[~self._judged[first, second]] = LEFT_OUT
        return labels

    def positives(self) -> Indices:
        """All marked pairs (K, 2)."""
        return self._marked

    def measures(self, first: Indices, second: Indices) -> dict[str, NDArray[np.float64]]:
        """The gap in images."""
        return {"gap [images]": np.abs(self.stamps[first] - self.stamps[second])}


class TraverseSource(MaskSource):
    """Two traverses of one route, with a file of the matching images.

    A pair is a query and a reference. Negatives within one traverse are not used: a net would learn to recognize the
    traverse. The images of both traverses form one run, in the order of the references that they show.
    """

    def __init__(self, truth: Path, queries: Path, references: Path, root: Path) -> None:
        """Read a mask (Q, R), or the lists of a VPR benchmark: see loopclosure.places.masks.read_matches."""
        paths = image_paths(queries), image_paths(references)
        count = len(paths[0])
        hard, soft = read_matches(truth, count, len(paths[1]))
        shown = np.flatnonzero(hard.any(axis=1))
        if not len(shown):
            raise InputError("marks no loop", truth)
        middles = [np.flatnonzero(row).mean() for row in hard[shown]]
        places = np.concatenate([np.interp(np.arange(count), shown, middles), np.arange(len(paths[1]), dtype=float)])
        order = np.argsort(places, kind="stable")
        is_query = order < count
        self._hard, self._soft = (_both_ways(mask)[np.ix_(order, order)] for mask in (hard, soft))
        self._judged = is_query[:, None] != is_query
        self._marked = np.argwhere(np.triu(self._hard, 1))
        self._min_gap = 0
        every = [*paths[0], *paths[1]]
        self.names = [relative(every[i], root) for i in order]
        self.tracks = self.groups = np.zeros(len(self.names), np.intp)
        self.group_names = [f"{queries.name} and {references.name}"]
        self.stamps = places[order]
        self.settings = {"source": f"{truth.name} of {queries.name} and {references.name}"}


def _both_ways(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Extend a mask (Q, R) of queries and references to all images: (Q + R, Q + R)."""
    queries, references = mask.shape
    nothing = [np.zeros((size, size), bool) for size in (queries, references)]
    return np.block([[nothing[0], mask], [mask.T, nothing[1]]])


class PlaceSource(PairSource):
    """Images, each in a group, and a list of positives: folders with equal names, tables, single images.

    Two images of different groups are a negative pair; two images of one group that are not listed are left out.
    """

    def __init__(
        self,
        images: Sequence[tuple[str, str]],
        positives: Sequence[tuple[int, int]],
        settings: dict[str, str],
        group_word: str = "place",
        min_gap: float = 0.0,
        sides: Sequence[int] | None = None,
    ) -> None:
        """Take images, each with the name of its group, and pairs of indices that are the same place.

        min_gap  in the given order of the groups: images of different groups nearer than this are left out, since
                 neighboring places look similar
        sides    if positives always join an image of one side (a folder, a season) with one of the other, negatives
                 must too, or a net learns to distinguish sides instead of places: pairs of one side are left out
        """
        self.names = [name for name, _ in images]
        self.group_word, self.settings, self._min_gap = group_word, settings, min_gap
        self.group_names = list(dict.fromkeys(group for _, group in images))
        numbers = {name: number for number, name in enumerate(self.group_names)}
        self.groups = np.array([numbers[group] for _, group in images], np.intp)
        self.tracks = np.zeros(len(images), np.intp)
        self.stamps = self.groups.astype(np.float64)
        self._sides = None if sides is None else np.array(sides)
        listed = np.sort(np.array(positives, np.intp).reshape(-1, 2), axis=1)
        self._codes = np.unique(listed @ np.array([len(images), 1]))

    def judge(self, first: Indices, second: Indices) -> NDArray[np.int8]:
        """Label pairs (N,): listed ones positive, those of different groups negative."""
        codes = np.minimum(first, second) * len(self.names) + np.maximum(first, second)
        labels = np.full(len(first), LEFT_OUT, np.int8)
        far = np.abs(self.stamps[first] - self.stamps[second]) >= self._min_gap
        labels[(self.groups[first] != self.groups[second]) & far] = NEGATIVE
        if self._sides is not None:
            labels[self._sides[first] == self._sides[second]] = LEFT_OUT
        labels[np.isin(codes, self._codes)] = POSITIVE
        return labels

    def positives(self) -> Indices:
        """All listed pairs (K, 2)."""
        return np.column_stack(np.divmod(self._codes, len(self.names)))


def folders_source(folder_a: Path, folder_b: Path, root: Path, min_gap: int = 0) -> PlaceSource:
    """Pair two folders: images with equal names are the same place (without the suffix: a.png and a.jpg are equal).

    Places are in natural order of their names; places nearer than ``min_gap`` to each other are not paired (frames of a
    traverse). Only images with a partner are used.
    """
    first, second = ({path.stem: path for path in image_paths(folder)} for folder in (folder_a, folder_b))
    places = [stem for stem in first if stem in second]
    if not places:
        raise InputError(f"and {folder_b} have no image of equal name", folder_a)
    names = [relative(folder[place], root) for folder in (first, second) for place in places]
    unpaired = len(first) + len(second) - 2 * len(places)
    settings = {
        "source": f"equal names in {folder_a.name} and {folder_b.name}, {unpaired} unpaired",
        "least gap": f"{min_gap} places",
    }
    positives = [(number, number + len(places)) for number in range(len(places))]
    sides = np.repeat([0, 1], len(places)).tolist()
    return PlaceSource(list(zip(names, places * 2, strict=True)), positives, settings, min_gap=min_gap, sides=sides)


def relative(path: Path, root: Path) -> str:
    """Return the path relative to the root, with slashes. Raises InputError if it is not below the root."""
    try:
        return path.resolve().relative_to(root.resolve()).as_posix()
    except ValueError:
        raise InputError(f"is not below the root folder {root}; give another --root", path) from None
