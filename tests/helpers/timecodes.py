"""SMPTE labels of frames: the way back from what ingest reads."""

from __future__ import annotations

from data_prep.capture.films.timecode import frames_of_label


def label_of_frame(frame: int, *, base: int, drop: bool) -> str:
    """The label of the frame with this number; it starts again after a day."""
    frame %= frames_of_label(24, 0, 0, 0, base=base, drop=drop)
    if drop:
        lost = 2 * base // 30
        minute = 60 * base - lost
        tens, rest = divmod(frame, 10 * 60 * base - 9 * lost)
        # The first minute of ten is whole; each of the others begins with dropped labels.
        frame += lost * (9 * tens + max(0, rest - lost) // minute)
    second, part = divmod(frame, base)
    minutes, second = divmod(second, 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours:02d}:{minutes:02d}:{second:02d}{';' if drop else ':'}{part:02d}"
