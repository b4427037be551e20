"""Ingest: a film of several cameras made here, with known starts, comes out synchronised; broken films are named."""

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from data_prep.capture.films.film import FilmFrames, probe
from data_prep.capture.films.sync import measure
from data_prep.capture.films.takes import find_takes, offset_seconds
from data_prep.ingest import IngestOptions, ingest, main
from gausim.core import DataError

Refused = Callable[..., str]
NTSC = Fraction(30000, 1001)
RATE = 48000
SIZE = 96, 64
# The lamp is on between these moments of the world [s].
LAMP = (0.83, 1.37)


def world_sound(seconds: float = 4.0) -> np.ndarray:
    """Knocks and voices in a room: bursts of noise of all lengths, over a little noise."""
    random = np.random.default_rng(3)
    sound = 0.002 * random.standard_normal(int(seconds * RATE))
    for start in np.sort(random.uniform(0, seconds - 0.2, 14)):
        length = int(random.uniform(0.01, 0.15) * RATE)
        burst = random.standard_normal(length) * np.exp(-np.arange(length) / (0.2 * length))
        sound[int(start * RATE) :][:length] += random.uniform(0.1, 0.4) * burst
    return sound


SOUND = world_sound()


@dataclass(frozen=True)
class Camera:
    """How one camera filmed the world: its start [s], rate, and what it records."""

    start: float
    rate: Fraction
    frames: int
    audio: str | None = "aac"
    loud: float = 1.0
    lamp: bool = True
    seed: int = 0
    turned: int = 0
    crf: str = "28"

    def picture(self, k: int) -> np.ndarray:
        """Frame k: a disc that swings over a pattern, lit by the lamp for the part of the exposure that it was on."""
        begin = self.start + k / float(self.rate)
        lit = max(0.0, min(LAMP[1], begin + 1 / float(self.rate)) - max(LAMP[0], begin)) * float(self.rate)
        x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
        linear = 0.05 + 0.03 * ((x // 8 + y // 8) % 2)
        centre = 48 + 20 * np.sin(2 * np.pi * 0.9 * begin)
        linear = np.where((x - centre) ** 2 + (y - 32) ** 2 < 150, 0.2, linear) * (1 + 2.5 * lit * self.lamp)
        noise = np.random.default_rng(1000 * self.seed + k).normal(0, 1.5, linear.shape)
        value = np.clip(255 * linear ** (1 / 2.2) + noise, 0, 255).astype(np.uint8)
        return np.stack([value, value, value // 2], axis=-1)

    def write(
        self,
        path: Path,
        *,
        stamps: list[int] | None = None,
        ticks: int = 1,
        aspect: Fraction | None = None,
        keys: int = 0,
    ) -> Path:
        """Encodes the film; ``stamps`` are time stamps in parts of frames where they are not 0, 1, 2 …"""
        path.parent.mkdir(parents=True, exist_ok=True)
        with av.open(str(path), "w") as film:
            video = film.add_stream("libx264", rate=self.rate)
            video.width, video.height, video.pix_fmt = *SIZE, "yuv420p"
            video.options = {"crf": self.crf, "preset": "veryfast", **({"g": str(keys), "bf": "0"} if keys else {})}
            video.codec_context.time_base = 1 / (self.rate * ticks)
            if aspect:
                video.codec_context.sample_aspect_ratio = aspect
            if self.turned:
                video.set_display_rotation(self.turned)
            track = film.add_stream(self.audio, rate=RATE, layout="mono") if self.audio else None
            for k in range(self.frames):
                frame = av.VideoFrame.from_ndarray(self.picture(k), format="rgb24")
                frame.pts, frame.time_base = (stamps[k] if stamps else k * ticks), 1 / (self.rate * ticks)
                film.mux(video.encode(frame))
            film.mux(video.encode())
            if track is not None:
                self._write_sound(film, track)
        return path

    def _write_sound(self, film: Any, track: Any) -> None:
        first, count = round(self.start * RATE), round(self.frames / float(self.rate) * RATE)
        heard = SOUND[first : first + count] * (0.5 + 0.2 * self.seed)
        # Each stands elsewhere in a room: echoes of its own, and the noise of its own microphone.
        for k, delay in enumerate((0.011 + 0.007 * self.seed, 0.029 - 0.003 * self.seed)):
            late = round(delay * RATE)
            heard[late:] += 0.5 ** (k + 1) * heard[:-late]
        heard = self.loud * (heard + 0.01 * np.random.default_rng(self.seed).standard_normal(len(heard)))
        if (self.audio or "").startswith("pcm"):
            frame = av.AudioFrame.from_ndarray((32767 * heard[None]).astype(np.int16), format="s16", layout="mono")
        else:
            frame = av.AudioFrame.from_ndarray(heard[None].astype(np.float32), format="fltp", layout="mono")
        frame.sample_rate, frame.pts, frame.time_base = RATE, 0, Fraction(1, RATE)
        film.mux(track.encode(frame))
        film.mux(track.encode())


def three_cameras(rate: Fraction, late: float = 7.3) -> dict[str, Camera]:
    """The second camera begins ``late`` frames after the first, the third three frames before the first."""
    frame, count = 1 / float(rate), int(1.6 * rate)
    audio = ("aac", "pcm_s16le", "aac")
    starts = enumerate((0, late, -3))
    return {f"cam_{i}": Camera(0.2 + start * frame, rate, count, audio[i], seed=i) for i, start in starts}


@pytest.fixture(scope="module", params=[Fraction(50), NTSC], ids=["50", "29.97"])
def filmed(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Fraction, Path]:
    """A sequence of three lossy films: MP4 with AAC, MOV with PCM, MP4 with AAC."""
    folder = tmp_path_factory.mktemp("films") / "poke"
    for name, camera in three_cameras(request.param).items():
        camera.write(folder / f"{name}{'.mov' if camera.audio == 'pcm_s16le' else '.mp4'}")
    return request.param, folder


@pytest.mark.parametrize("method", ["audio", "flash"])
def test_offsets_are_found_to_a_quarter_frame(filmed: tuple[Fraction, Path], method: str) -> None:
    rate, folder = filmed
    take = find_takes(folder)[0]
    films = {name: probe(path) for name, path in take.films.items()}
    assert all(film.rate == rate and not film.variable for film in films.values())
    offsets = measure(films, method, given={})
    later = {name: (offsets.seconds[name] - offsets.seconds["cam_0"]) * float(rate) for name in films}
    assert later["cam_1"] == pytest.approx(7.3, abs=0.25) and later["cam_2"] == pytest.approx(-3, abs=0.25)
    assert offsets.resolution["cam_1"] * float(rate) <= 0.5


@pytest.mark.parametrize("method", ["flash", pytest.param("auto", marks=pytest.mark.slow)])
def test_frames_come_out_synchronised(filmed: tuple[Fraction, Path], tmp_path: Path, method: str) -> None:
    """Each output frame shows the disc where it was, within the residual that is reported, as the decoder gave it."""
    rate, folder = filmed
    found = ingested(folder, tmp_path / "out", sync=method)
    assert found["method"] == ("audio" if method == "auto" else method)
    cameras, truth = found["cameras"], three_cameras(rate)
    reference = truth[found["reference"]]
    first = {name: facts["kept"][0] for name, facts in cameras.items()}
    start = reference.start + first[found["reference"]] / float(rate)
    for name, facts in cameras.items():
        assert facts["kept"][1] - facts["kept"][0] + 1 == found["frames"] > 0.9 * rate
        true_residual = (truth[name].start + first[name] / float(rate) - start) * float(rate)
        assert abs(true_residual) <= 0.5
        if method == "flash":
            assert facts["residual_frames"]["mean"] == pytest.approx(true_residual, abs=0.25)
        for k in (0, found["frames"] - 1):
            file = tmp_path / f"out/sequences/seq_000/{name}/{k:04d}.png"
            written = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
            assert written.shape == (*SIZE[::-1], 3) and written.dtype == np.uint8
            true = truth[name].picture(first[name] + k)
            assert np.abs(cv2.cvtColor(written, cv2.COLOR_BGR2RGB).astype(int) - true).mean() < 12
    with av.open(str(folder / "cam_0.mp4")) as film:
        decoded = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    written = cv2.imread(str(tmp_path / "out/sequences/seq_000/cam_0/0005.png"))
    assert np.array_equal(cv2.cvtColor(written, cv2.COLOR_BGR2RGB), decoded[first["cam_0"] + 5])
    assert (tmp_path / "out" / "sequences" / "seq_000" / "sync.png").stat().st_size > 1000


# ---- what does not go together, and what is broken


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two short films of 25 frames per second without sound or lamp; the second begins 2.5 frames later."""
    folder = tmp_path_factory.mktemp("pair")
    for i in range(2):
        Camera(0.1 * i, Fraction(25), 20, audio=None, lamp=False, seed=i).write(folder / f"side_{i}.mp4")
    return folder


@pytest.fixture
def refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Refused:
    """Gives the error that the command ends with; nothing may be left that looks like a result."""

    def run(folder: Path, options: str = "") -> str:
        assert main([str(folder), "--out", str(tmp_path / "refused"), *options.split()]) == 2
        message = capsys.readouterr().err
        assert message.startswith("error: ") and not (tmp_path / "refused" / "stage.json").exists()
        return message

    return run


def ingested(folder: Path, out: Path, **options: Any) -> dict[str, Any]:
    """What the manifest says of the only sequence."""
    return ingest(folder, out, IngestOptions(**options))["results"]["sequences"]["seq_000"]


@pytest.mark.parametrize(("options", "messages"), [
    ("", ("audio: cam_0 (side_0.mp4): has no sound",
          "flash: cam_0 (side_0.mp4): no flash", "--offsets")),
    ("--sync offsets --offsets cam_1=5s", ("cam_1 (side_1.mp4) begins", "no time in common")),
    ("--sync offsets --offsets cam_1=0 --start 5", ("after leaving out 5 s",)),
    ("--sync offsets --offsets cam_1=1f --reference x", ("no camera 'x'",)),
])  # fmt: skip
def test_films_that_nothing_brings_together_are_refused(pair, refused, options, messages) -> None:
    """The camera is named, and every method says why it does not apply."""
    message = refused(pair, options)
    assert all(part in message for part in messages), message


def test_silence_and_strangers_sounds_are_refused(tmp_path: Path) -> None:
    """A silent camera, and two that heard different things, are no measurement."""
    Camera(0.2, Fraction(25), 40).write(tmp_path / "a.mp4")
    Camera(0.2, Fraction(25), 40, loud=0.0, seed=1).write(tmp_path / "b.mp4")
    films = {"cam_0": probe(tmp_path / "a.mp4"), "cam_1": probe(tmp_path / "b.mp4")}
    with pytest.raises(DataError, match=r"cam_1 \(b.mp4\).*silent"):
        measure(films, "audio", given={})
    Camera(2.2, Fraction(25), 40, seed=1).write(tmp_path / "c.mp4")
    films["cam_1"] = probe(tmp_path / "c.mp4")
    with pytest.raises(DataError, match=r"cam_1 \(c.mp4\) against cam_0.*does not fix its place in time"):
        measure(films, "audio", given={})


@pytest.mark.parametrize("offset", ["2.5f", "0.1"])
def test_offsets_choose_frames_and_trim(pair: Path, tmp_path: Path, offset: str) -> None:
    """Half a frame is the most that rounding leaves; what only one camera saw is cut off."""
    cameras = ingested(pair, tmp_path / "out", sync="offsets", offsets={"side_1": offset})["cameras"]
    assert cameras["cam_1"]["residual_frames"]["largest"] in (0.0, pytest.approx(0.5, abs=1e-3))
    assert cameras["cam_0"]["kept"][0] in (2, 3) and cameras["cam_0"]["kept"][1] == 19
    later = cameras["cam_1"]["offset_frames"] - cameras["cam_0"]["offset_frames"]
    assert cameras["cam_1"]["kept"][0] == 0 and later == pytest.approx(2.5)
    assert cameras["cam_1"]["repeated"] == 0


def test_start_duration_and_size(pair: Path, tmp_path: Path) -> None:
    part = {"start": 0.2, "duration": 0.3, "max_side": 48}
    found = ingested(pair, tmp_path / "out", sync="offsets", offsets={"cam_1": "2f"}, reference="side_0", **part)
    assert found["frames"] == 8 and found["reference"] == "cam_0"
    assert found["cameras"]["cam_0"]["kept"] == [7, 14] and found["cameras"]["cam_1"]["kept"] == [5, 12]
    assert cv2.imread(str(tmp_path / "out/sequences/seq_000/cam_1/0000.png")).shape == (32, 48, 3)


def test_whole_multiples_of_a_rate_go_together_and_others_do_not(tmp_path: Path, refused: Refused) -> None:
    """50 beside 25 gives every second frame; 29.97 beside 25 is refused by name."""
    folder = tmp_path / "in"
    Camera(0.1, Fraction(25), 20, audio=None, seed=1).write(folder / "a.mp4")
    Camera(0.1 + 3 / 50, Fraction(50), 40, audio=None, seed=1).write(folder / "b.mp4")
    found = ingested(folder, tmp_path / "out", sync="offsets", offsets={"b": "3f"})
    assert found["fps"] == 25 and found["cameras"]["cam_0"]["fps"] == 25 and found["cameras"]["cam_1"]["fps"] == 50
    kept, residual = (found["cameras"]["cam_1"][name] for name in ("kept", "residual_frames"))
    assert kept[1] - kept[0] == 2 * (found["frames"] - 1) and residual["largest"] <= 0.5 + 1e-6
    Camera(0.1, NTSC, 20, audio=None).write(folder / "b.mp4")
    message = refused(folder, "--sync offsets --offsets b=0")
    assert "cam_1 (b.mp4): 29.97" in message and "no whole multiple" in message


def test_missing_frames_leave_a_residual_and_are_refused(tmp_path: Path, refused: Refused) -> None:
    """A camera that dropped frames has none near their places: which camera and which frame is said."""
    folder = tmp_path / "in"
    Camera(0.0, Fraction(25), 20, audio=None).write(folder / "a.mp4")
    Camera(0.0, Fraction(25), 17, audio=None).write(folder / "b.mp4", stamps=[*range(9), *range(12, 20)])
    assert probe(folder / "b.mp4").variable
    message = refused(folder, "--sync offsets --offsets b=0")
    assert "cam_1 (b.mp4): output frame" in message and "allowed 0.5" in message and "rate varies" in message
    found = ingested(folder, tmp_path / "cut", sync="offsets", offsets={"b": "0"}, duration=0.3)
    assert found["frames"] == 8  # before the gap all is well


def test_turned_cameras_come_out_upright(tmp_path: Path) -> None:
    """The display matrix of a phone held upright is applied, not only read."""
    camera = Camera(0.1, Fraction(25), 6, audio=None, turned=90, crf="10")
    camera.write(tmp_path / "in" / "a.mp4")
    found = ingested(tmp_path / "in", tmp_path / "out")
    assert found["method"] == "single" and found["cameras"]["cam_0"]["rotation"] == 90
    assert found["cameras"]["cam_0"]["size"] == list(SIZE[::-1])
    written = cv2.cvtColor(cv2.imread(str(tmp_path / "out/sequences/seq_000/cam_0/0003.png")), cv2.COLOR_BGR2RGB)
    assert np.abs(written.astype(int) - np.rot90(camera.picture(3))).mean() < 6


def test_pixels_become_square(tmp_path: Path) -> None:
    """An anamorphic film: 96 samples of 4:3 are 128 pixels."""
    path = Camera(0.1, Fraction(25), 6, audio=None).write(tmp_path / "in" / "a.mp4", aspect=Fraction(4, 3))
    assert probe(path).size == (128, 64)
    ingested(tmp_path / "in", tmp_path / "out")
    assert cv2.imread(str(tmp_path / "out/sequences/seq_000/cam_0/0003.png")).shape == (64, 128, 3)


def test_frames_before_the_first_key_frame_are_left_out(tmp_path: Path) -> None:
    whole = Camera(0.1, Fraction(25), 40, audio=None).write(tmp_path / "whole.mp4", keys=12)
    (tmp_path / "in").mkdir()
    with av.open(str(whole)) as source, av.open(str(tmp_path / "in" / "cut.mp4"), "w") as target:
        stream = target.add_stream_from_template(source.streams.video[0])
        for packet in [p for p in source.demux(video=0) if p.size][5:]:
            packet.stream = stream
            target.mux(packet)
    found = ingested(tmp_path / "in", tmp_path / "out")
    assert found["frames"] == 28 and any("between key frames" in note for note in found["notes"])


def test_jitter_is_no_other_rate_and_slow_motion_is(tmp_path: Path) -> None:
    """A phone's time stamps are some milliseconds off; a film whose rate changes is read by ingest alone."""
    rng = np.random.default_rng(1)
    for name in ("a", "b"):
        stamps = [round(100 * (k + rng.uniform(-0.15, 0.15))) for k in range(30)]
        Camera(0.0, Fraction(30), 30, audio=None).write(tmp_path / "in" / f"{name}.mp4", stamps=stamps, ticks=100)
        assert not probe(tmp_path / "in" / f"{name}.mp4").variable
    found = ingested(tmp_path / "in", tmp_path / "out", sync="offsets", offsets={"b": "0"})
    assert found["fps"] == pytest.approx(30, rel=2e-3)
    assert all(c["residual_frames"]["largest"] < 0.4 for c in found["cameras"].values())
    slow = [*range(0, 40, 4), *range(40, 60), *range(60, 100, 4)]
    Camera(0.0, Fraction(120), len(slow), audio=None).write(tmp_path / "slow.mp4", stamps=slow)
    with pytest.raises(DataError, match=r"slow\.mp4: its rate varies.*ingest"):
        FilmFrames(tmp_path / "slow.mp4")


FAULTS: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda good: b"", "noise": lambda good: bytes(range(256)) * 40, "header": lambda good: good[:600],
    "no end": lambda good: good[: len(good) * 2 // 3],
    "middle": lambda good: good[: len(good) // 3] + bytes(len(good) // 6) + good[len(good) // 3 + len(good) // 6 :],
}  # fmt: skip


@pytest.mark.parametrize(("fault", "suffix"), [*((fault, ".mp4") for fault in FAULTS), ("no end", ".mkv")])
def test_broken_films_are_named(tmp_path: Path, refused: Refused, suffix: str, fault: str) -> None:
    film = Camera(0.1, Fraction(25), 20, crf="1").write(tmp_path / "in" / f"bad{suffix}")
    film.write_bytes(FAULTS[fault](film.read_bytes()))
    message = refused(tmp_path / "in")
    assert f"bad{suffix}: " in message and ("empty (0 bytes)" in message) == (fault == "empty")


# ---- which films, and starting again


def test_folders_are_sequences_and_offsets_seconds_or_frames(tmp_path: Path) -> None:
    for take in ("take_10", "take_2"):
        for camera in ("left", "right"):
            (tmp_path / take).mkdir(exist_ok=True)
            (tmp_path / take / f"{camera}.mp4").touch()
    takes = find_takes(tmp_path)
    assert [(t.name, t.source) for t in takes] == [("seq_000", "take_2"), ("seq_001", "take_10")]
    assert takes[0].labels == {"cam_0": "left", "cam_1": "right"}
    assert offset_seconds("7.3f", 50) == pytest.approx(0.146) and offset_seconds("-0.5s", 50) == -0.5
    for text in ("", "abc", "1e999", "nan", "7 frames"):
        with pytest.raises(DataError, match="offset"):
            offset_seconds(text, 25)


@pytest.mark.parametrize(("names", "message"), [
    ((), "no films in it"),
    (("a.mp4", "b/c.mp4"), "both in it and in b"),
    (("a.mp4", "a.mov"), "name one camera"),
    (("x/a.mp4", "x/b.mp4", "y/a.mp4"), "sequence 'y' has the cameras"),
])  # fmt: skip
def test_unclear_folders_are_refused(tmp_path: Path, names: tuple[str, ...], message: str) -> None:
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    with pytest.raises(DataError, match=message):
        find_takes(tmp_path)
