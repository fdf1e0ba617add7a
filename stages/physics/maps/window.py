"""A rectangle of pixels on a grid."""

from __future__ import annotations

from typing import NamedTuple

Box = tuple[int, int, int, int]  # row, col, height, width: a Window, or any tuple like it


class Window(NamedTuple):
    """First row and column on the grid, and the number of rows and columns."""

    row: int
    col: int
    height: int
    width: int

    @property
    def part(self) -> tuple[slice, slice]:
        """Rows and columns to cut it out of the whole grid."""
        return slice(self.row, self.row + self.height), slice(self.col, self.col + self.width)

    def padded(self, margin: int, shape: tuple[int, int]) -> Window:
        """With ``margin`` more pixels on every side, as far as a grid of ``shape`` goes."""
        top, left = max(0, self.row - margin), max(0, self.col - margin)
        bottom = min(shape[0], self.row + self.height + margin)
        right = min(shape[1], self.col + self.width + margin)
        return Window(top, left, bottom - top, right - left)

    def within(self, outer: Window) -> Window:
        """The same rectangle, counted from the first pixel of one around it."""
        return Window(self.row - outer.row, self.col - outer.col, self.height, self.width)

    def union(self, other: Window) -> Window:
        """The smallest window that holds both."""
        top, left = min(self.row, other.row), min(self.col, other.col)
        bottom = max(self.row + self.height, other.row + other.height)
        right = max(self.col + self.width, other.col + other.width)
        return Window(top, left, bottom - top, right - left)

    def widened(self, factor: int, shape: tuple[int, int]) -> Window:
        """To whole blocks of ``factor`` x ``factor`` pixels, counted from the grid's corner, as far as a grid of ``shape`` goes."""
        top, left = self.row // factor * factor, self.col // factor * factor
        bottom = min(shape[0], -(-(self.row + self.height) // factor) * factor)
        right = min(shape[1], -(-(self.col + self.width) // factor) * factor)
        return Window(top, left, bottom - top, right - left)
