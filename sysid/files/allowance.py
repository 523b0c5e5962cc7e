"""Memory that the numbers of a file may take: checked before any is taken."""

from __future__ import annotations

from sysid.errors import InputError

_LEAST = 2**28  # bytes that any file may unpack to
_TIMES = 16  # its size, where that is more: records of dead channels pack well


class Allowance:
    """Bytes that are left for the numbers of a file.

    Parameters
    ----------
    size : int
        Of the file, bytes.

    Attributes
    ----------
    left : int
    """

    def __init__(self, size: int) -> None:
        self._size, self.left = size, max(_LEAST, _TIMES * size)

    def take(self, name: str, count: int) -> None:
        """Take away what an array needs.

        Raises
        ------
        InputError
            Where that is more than is left.
        """
        if count > self.left:
            raise InputError(
                f"{name} claims {count:.3g} bytes, in a file of {self._size} bytes: it is damaged, or export fewer "
                "channels a file"
            )
        self.left -= count
