"""Tables of measurements that grow while a run goes on."""

import numpy as np

Arrays = dict[str, np.ndarray]


class Table:
    """Named columns [rows, ...] that grow by blocks of rows."""

    def __init__(self, columns: Arrays):
        """Begins with columns, which may be without rows, or with none at all."""
        self._blocks = [columns] if columns else []

    def append(self, block: Arrays) -> None:
        """Takes in rows: every column, [rows, ...] each."""
        self._blocks.append(block)

    def columns(self) -> Arrays:
        """Returns all rows."""
        if len(self._blocks) > 1:
            self._blocks = [_joined(self._blocks)]
        return dict(self._blocks[0]) if self._blocks else {}

    def latest(self, count: int, *names: str) -> Arrays:
        """Returns the last ``count`` rows, of blocks none of which is empty, or all there are.

        Args:
          count: how many rows.
          names: of the columns; all if none is named.
        """
        if not self._blocks:
            return {}
        tails = [{name: b[name][-count:] for name in names or b} for b in self._blocks[-count:]]
        return {name: x[-count:] for name, x in _joined(tails).items()}


def _joined(blocks: list[Arrays]) -> Arrays:
    """Returns the rows of all blocks, in order."""
    return {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}
