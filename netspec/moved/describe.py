"""Was netspec.describe."""

from netspec.features.describer import Describer as Describer
