"""The picture of a path before and after its loops were closed."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from loopclosure.closing.close import Closed
from loopclosure.closing.drift import aligned
from loopclosure.report.plots import COLORS, FALSE, FOUND, STYLE
from netspec.files.whole_file import whole_file

AXES = ("x [m]", "y [m]", "z [m]")


def draw_paths(path: Path, closed: Closed, names: tuple[str, str] = ("odometry", "loops closed")) -> None:
    """Draw both paths from the side from which they look largest, and the true one where it is known, as PNG.

    Paths are moved and turned as a whole to be nearest to the true one. Lines across are loops: green if used, red if
    they contradict the others.
    """
    paths = dict(zip(names, (closed.odometry, closed.poses), strict=True))
    if closed.truth is not None:
        known = np.all(np.isfinite(closed.truth), axis=1)
        if np.count_nonzero(known) >= 3:
            paths = {name: aligned(poses, closed.truth, known) for name, poses in paths.items()}
            paths["true"] = closed.truth[known]
    reference = list(paths.values())[-1]
    across = np.sort(np.argsort(np.ptp(reference[:, :3], axis=0), kind="stable")[1:])
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9, 4.6), layout="constrained")
        errors = closed.errors()
        for number, (axis, name) in enumerate(
            zip(figure.subplots(1, 2, sharex=True, sharey=True), paths, strict=False)
        ):
            poses = paths[name][:, across]
            if "true" in paths:
                axis.plot(*paths["true"][:, across].T, color="#9e9e9e", lw=2.2, label="true path")
            ends = np.array([(edge.first, edge.second) for edge in closed.edges], int).reshape(-1, 2)
            colors = [FOUND if accepted else FALSE for accepted in closed.accepted]
            axis.add_collection(LineCollection(list(poses[ends]), colors=colors, linewidths=0.6, alpha=0.6))
            axis.plot(*poses.T, color=COLORS[1 - number], lw=1, label=name)
            error = "" if errors is None else f", ATE {next(iter(errors.values()))[number]:.3g} m"
            axis.set_title(f"{name}{error}")
            axis.set_xlabel(AXES[across[0]])
            axis.set_aspect("equal")
            axis.legend(loc="best")
            if number == 0:
                axis.set_ylabel(AXES[across[1]])
        with whole_file(path) as unfinished:
            figure.savefig(unfinished, format="png")
