"""SMPTE time codes as numbers of frames: with and without dropped labels, exact over midnight.

A time code labels frames; it does not measure seconds. At 30000/1001 frames per second thirty labels last 1.001 s, so
the label's clock falls behind by 108 frames an hour. Drop-frame counting leaves out the labels ;00 and ;01 of every
minute that is no multiple of ten (SMPTE ST 12-1), four of them at 60000/1001, and no frame.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from fractions import Fraction

from gausim.core import DataError

_LABEL = re.compile(r"(\d{2}):(\d{2}):(\d{2})([:;.,])(\d{2,3})")
# Rates that have a drop-frame count: labels dropped per minute.
_DROPPED = {30: 2, 60: 4, 120: 8}


@dataclass(frozen=True)
class Timecode:
    """The label of one frame."""

    text: str  # as it stands in the file
    frame: int  # frames since the label 00:00:00:00
    base: int  # labels per nominal second, e.g. 30 at 30000/1001 frames per second
    drop: bool  # labels are dropped
    rate: Fraction  # frames that are shown per second, exactly

    @property
    def seconds(self) -> Fraction:
        """Time since the label 00:00:00:00 was shown [s], exactly."""
        return self.frame / self.rate

    def seconds_after(self, other: Timecode) -> Fraction:
        """Time of this frame after ``other`` [s], by the shorter way around midnight.

        Raises:
            DataError: the two count differently, so that their difference means nothing.
        """
        # At a rate that is no whole number a labelled second is longer than a second.
        if self.drop != other.drop or (self.rate.denominator == 1) != (other.rate.denominator == 1):
            raise DataError(f"time codes {self._described()} and {other._described()} do not count alike.")
        day = frames_of_label(24, 0, 0, 0, base=self.base, drop=self.drop) / self.rate
        difference = (self.seconds - other.seconds) % day
        return difference - day if difference > day / 2 else difference

    def _described(self) -> str:
        return f"{self.text} ({'drop' if self.drop else 'non-drop'} frame, {float(self.rate):.6g} per second)"


def parse_timecode(text: str, rate: Fraction) -> Timecode:
    """Reads a label ``HH:MM:SS:FF`` (``;``, ``.`` or ``,`` before FF: drop frame).

    Raises:
        DataError: it is no such label, or one that this count does not have.
    """
    match = _LABEL.fullmatch(text.strip())
    if match is None:
        raise DataError(f"time code {text!r}: expected HH:MM:SS:FF, or HH:MM:SS;FF for drop frame.")
    hours, minutes, seconds, frames = (int(match[i]) for i in (1, 2, 3, 5))
    base, drop = round(rate), match[4] != ":"
    if hours > 23 or minutes > 59 or seconds > 59 or frames >= base:
        raise DataError(
            f"time code {text!r}: expected at most 23:59:59:{base - 1} at {float(rate):.6g} frames per second."
        )
    if drop and (base not in _DROPPED or rate.denominator == 1):
        raise DataError(
            f"time code {text!r}: drop frame exists at 29.97, 59.94 and 119.88 frames per second, not at "
            f"{float(rate):.6g}."
        )
    if drop and minutes % 10 and seconds == 0 and frames < _DROPPED[base]:
        raise DataError(f"time code {text!r}: drop-frame counting leaves this label out.")
    return Timecode(text, frames_of_label(hours, minutes, seconds, frames, base=base, drop=drop), base, drop, rate)


def frames_of_label(hours: int, minutes: int, seconds: int, frames: int, *, base: int, drop: bool) -> int:
    """Number of frames between the label 00:00:00:00 and this one."""
    total = 60 * hours + minutes
    count = (60 * total + seconds) * base + frames
    return count - _DROPPED[base] * (total - total // 10) if drop else count
