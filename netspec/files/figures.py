"""The style of matplotlib figures, and their conversion to PNG. This module does not import matplotlib."""

from __future__ import annotations

import io
from typing import Any

# Distinguishable for color-blind readers (Okabe and Ito).
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8C6D31")
GRID, PALE = "#e6e6e6", "#777777"  # lines of a grid, and less important text
STYLE: dict[Any, Any] = {  # for matplotlib.rc_context
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
    "legend.frameon": False,
}


def png(figure: Any) -> bytes:
    """Return a matplotlib figure as PNG. Equal figures give equal bytes."""
    data = io.BytesIO()
    figure.savefig(data, format="png", metadata={"Software": None})
    return data.getvalue()
