"""Time codes: drop-frame labels are those of SMPTE ST 12-1, every label has one frame, midnight is passed."""

from __future__ import annotations

from fractions import Fraction

import pytest
from helpers.timecodes import label_of_frame

from data_prep.capture.films.timecode import parse_timecode
from gausim.core import DataError

NTSC = Fraction(30000, 1001)


@pytest.mark.parametrize(
    ("text", "frame"),
    [
        ("00:00:59;29", 1799),
        ("00:01:00;02", 1800),  # ;00 and ;01 are left out
        ("00:09:59;29", 17981),
        ("00:10:00;00", 17982),  # every tenth minute is whole
        ("01:00:00;00", 107892),
        ("23:59:59;29", 2589407),
    ],
)
def test_drop_frame_numbers_of_the_standard(text: str, frame: int) -> None:
    assert parse_timecode(text, NTSC).frame == frame
    assert label_of_frame(frame, base=30, drop=True) == text


@pytest.mark.parametrize(
    ("rate", "drop"), [(NTSC, True), (Fraction(60000, 1001), True), (NTSC, False), (Fraction(50), False)]
)
def test_every_frame_has_a_label_of_its_own(rate: Fraction, drop: bool) -> None:
    base = round(rate)
    around = [minute * 60 * base + k for minute in (*range(22), 60 * 23, 60 * 24 - 2) for k in range(-80, 20, 3)]
    for frame in [*range(80), *(n for n in around if n >= 0)]:
        label = label_of_frame(frame, base=base, drop=drop)
        code = parse_timecode(label, rate)
        assert code.frame == frame and code.drop == drop


def test_drop_frame_keeps_to_the_clock_and_non_drop_does_not() -> None:
    an_hour = parse_timecode("01:00:00;00", NTSC).seconds
    assert abs(float(an_hour) - 3600) < 0.004
    assert float(parse_timecode("01:00:00:00", NTSC).seconds) == pytest.approx(3603.6, abs=1e-9)
    assert parse_timecode("01:00:00:00", Fraction(25)).seconds == 3600


def test_differences_pass_minutes_and_midnight_exactly() -> None:
    before, after = parse_timecode("00:00:59;29", NTSC), parse_timecode("00:01:00;02", NTSC)
    assert after.seconds_after(before) == 1 / NTSC
    late, early = parse_timecode("23:59:59;29", NTSC), parse_timecode("00:00:00;01", NTSC)
    assert early.seconds_after(late) == 2 / NTSC and late.seconds_after(early) == -2 / NTSC
    half, full = parse_timecode("10:00:00:12", Fraction(25)), parse_timecode("10:00:00:25", Fraction(50))
    assert full.seconds_after(half) == Fraction(1, 50)
    whole = parse_timecode("01:00:00:00", NTSC)
    for other in (before, half):
        with pytest.raises(DataError, match="do not count alike"):
            whole.seconds_after(other)


@pytest.mark.parametrize(
    ("text", "rate", "message"),
    [
        ("01:00:00", NTSC, "expected HH:MM:SS:FF"),
        ("aa:00:00:00", NTSC, "expected HH:MM:SS:FF"),
        ("24:00:00:00", NTSC, "at most 23:59:59:29"),
        ("00:00:00:30", NTSC, "at most 23:59:59:29"),
        ("00:01:00;01", NTSC, "leaves this label out"),
        ("00:00:01;00", Fraction(25), "drop frame exists"),
        ("00:00:01;00", Fraction(30), "drop frame exists"),
    ],
)
def test_labels_that_cannot_be_are_refused(text: str, rate: Fraction, message: str) -> None:
    with pytest.raises(DataError, match=message):
        parse_timecode(text, rate)
