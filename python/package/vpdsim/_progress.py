"""Progress bars: those of tqdm if it is there, else a line on stderr."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, Union

Progress = Union[bool, Callable[[int, int], Any]]
"""True for a bar, or a function that is called with what is done and the whole, twenty times a second."""


def follower(progress: Progress, unit: str) -> Callable[[int, int], Any] | None:
    """The function that is to be called with what is done and the whole."""
    if callable(progress):
        return progress
    if not progress:
        return None
    try:
        from tqdm.auto import tqdm
    except ImportError:
        return Line(unit)
    bar: Any = None

    def move(done: int, whole: int) -> None:
        nonlocal bar
        if bar is None:
            bar = tqdm(total=whole, unit=unit, unit_scale=True)
        bar.total = whole
        bar.update(done - bar.n)
        if done >= whole:
            bar.close()

    return move


class Line:
    """A line that is written over."""

    def __init__(self, unit: str) -> None:
        self.unit = unit
        self.shown = -1

    def __call__(self, done: int, whole: int) -> None:
        percent = 100 * done // max(whole, 1)
        if percent != self.shown:
            self.shown = percent
            end = "\n" if done >= whole else ""
            print(f"\r{percent:>3} % of {whole} {self.unit}", end=end, file=sys.stderr, flush=True)
