"""``loopclosure similarity``."""

from __future__ import annotations

import argparse

from loopclosure.descriptors.feature_file import read_features
from loopclosure.descriptors.similarity import METRICS, top_k, write_similarity, write_top_k
from loopclosure.errors import InputError
from loopclosure.places.truth import Exclusion
from netspec.terminal.commands import Commands, WrongUsage
from netspec.terminal.output import bar


def add_to(commands: Commands) -> None:
    """Add the command."""
    p = commands.add("similarity", _similarity, "compare all descriptors of a file, by blocks")
    p.add_argument("features", help="the .npz file of the queries")
    p.add_argument("--references", metavar="F.npz", help="the references (default: the queries, as one sequence)")
    p.add_argument("--metric", choices=METRICS, default=METRICS[0], help=f"of the descriptors (default: {METRICS[0]})")
    p.add_argument("--top-k", type=int, metavar="K", help="write the best K of each query as CSV, not all as .npy")
    p.add_argument("--exclude-frames", type=int, default=0, metavar="N", help="of --top-k in one sequence")
    p.add_argument("--exclude-seconds", type=float, default=0.0, metavar="S", help="the same, by stamps")
    p.add_argument("--out", required=True, metavar="FILE", help="the file to write")


def _similarity(a: argparse.Namespace) -> None:
    excluded = a.exclude_frames or a.exclude_seconds
    if excluded and a.top_k is None:
        raise WrongUsage("an exclusion belongs to --top-k; the matrix holds all pairs")
    if excluded and a.references is not None:
        raise WrongUsage("an exclusion belongs to one sequence; with --references nothing is near in time")
    queries = read_features(a.features)
    references = None if a.references is None else read_features(a.references).features
    if queries.views > 1:
        raise InputError("describes several views of an image; this command compares one", a.features)
    if a.top_k is None:
        shape = write_similarity(a.out, queries.features, references, a.metric, bar)
        print(f"{shape[0]} x {shape[1]} scores, float32: {a.out}")
        return
    exclusion = Exclusion(a.exclude_frames, a.exclude_seconds) if references is None else None
    found = top_k(queries.features, references, a.top_k, a.metric, exclusion, queries.stamps)
    write_top_k(a.out, found)
    print(f"the best {a.top_k} of {len(found.indices)} queries ({exclusion or 'no pair excluded'}): {a.out}")
