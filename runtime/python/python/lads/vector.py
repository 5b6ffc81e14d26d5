"""Steps many controllers of one policy together over threads."""

from dataclasses import dataclass

import numpy as np

from ._lads import Controllers

__all__ = ["Controllers", "Report"]


@dataclass(frozen=True, eq=False)
class Report:
    """Result of a control step of every row; the last three fields are None for a policy that selects no index."""

    timestep: np.ndarray
    """Number of control steps since each row's context began, int64 `[count]`."""
    index: np.ndarray | None
    """The index in force, int64 `[count]`."""
    margin: np.ndarray | None
    """The largest score of the last selection minus the second largest, float32 `[count]`."""
    fresh: np.ndarray | None
    """True if this step selected the index, bool `[count]`."""
