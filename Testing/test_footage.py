from __future__ import annotations

import json
import os
import shutil
import struct
import sys

import cv2
import numpy as np
import pytest
from cases import camera, write_inputs

from ExpectedAppearancesLib import files
from ExpectedAppearancesLib.case.case import Case
from ExpectedAppearancesLib.cli import main
from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.geometry.pose import look_at
from ExpectedAppearancesLib.registration import predictor as predictor_module
from ExpectedAppearancesLib.registration.encoding import fit_encoding
from ExpectedAppearancesLib.registration.footage import Footage, read_frame_rgb
from ExpectedAppearancesLib.registration.poses_file import read_poses, write_poses
from ExpectedAppearancesLib.registration.predictor import Prediction

LEVELS = range(20, 240, 11)  # grey level of each frame of the test video


def grey(level: int, size: int = 96) -> np.ndarray:
    return np.full((size, size, 3), (level, level // 2, 60), np.uint8)


def write_video(path, codec: str, rate_hz: float = 25) -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), rate_hz, (96, 96))
    for level in LEVELS:
        writer.write(np.ascontiguousarray(grey(level)[..., ::-1]))
    writer.release()


def unequal_durations(data: bytearray) -> None:
    """Of an MP4 of 20 frames: each of the second ten lasts four times as long."""
    at = data.index(b"stts") - 4
    size, count, ticks = *struct.unpack_from(">I", data, at), *struct.unpack_from(">II", data, at + 16)
    assert (size, count) == (24, 20)  # one run of equal ones, which becomes two
    data[at : at + size] = struct.pack(">I4s6I", 32, b"stts", 0, 2, 10, ticks, 10, 4 * ticks)
    for name in (b"moov", b"trak", b"mdia", b"minf", b"stbl"):  # that it lies in; all behind the frames
        box = data.index(name) - 4
        struct.pack_into(">I", data, box, struct.unpack_from(">I", data, box)[0] + 8)
    for name, place in ((b"mvhd", 20), (b"tkhd", 24), (b"mdhd", 20)):
        duration = data.index(name) + place
        struct.pack_into(">I", data, duration, struct.unpack_from(">I", data, duration)[0] * 5 // 2)
    edits = data.index(b"edts")
    data[edits : edits + 4] = b"free"


@pytest.fixture
def video(tmp_path):
    """20 frames at 12.5 Hz, each told by its red."""
    write_video(tmp_path / "Op ä.avi", "MJPG", 12.5)
    return tmp_path / "Op ä.avi"


def test_video_gives_its_frames_in_rgb_with_their_times(video):
    footage = Footage([video])
    frames = list(footage)
    assert footage.is_video and footage.count == len(frames) == len(LEVELS)
    np.testing.assert_allclose([f.time_s for f in frames], np.arange(20) / 12.5, atol=1e-6)
    assert [f.image.name for f in frames[:2]] == ["Op ä.avi#frame=0", "Op ä.avi#frame=1"]
    # Kept frames must not be overwritten by later ones.
    for level, frame in zip(LEVELS, frames, strict=True):
        np.testing.assert_allclose(frame.read_rgb()[40, 40], [level, level // 2, 60], atol=6)


@pytest.mark.parametrize(("suffix", "codec"), [(".avi", "MJPG"), (".mp4", "mp4v")])
def test_a_written_frame_can_be_read_again(tmp_path, suffix, codec):
    write_video(tmp_path / f"v{suffix}", codec)
    for number in (13, 0, 19):
        image = read_frame_rgb(tmp_path / f"v{suffix}#frame={number}")
        np.testing.assert_allclose(image[40, 40], grey(LEVELS[number])[0, 0], atol=6)
    for wrong in (f"v{suffix}#frame=20", f"v{suffix}#frame=x", f"w{suffix}#frame=1"):
        with pytest.raises(InputError, match=wrong):
            read_frame_rgb(tmp_path / wrong)


def test_a_frame_is_found_where_frames_are_not_equally_long(tmp_path):
    """As recorders write them that leave frames out: by the mean rate another frame is found, or none."""
    path = tmp_path / "v.mp4"
    write_video(path, "mp4v")
    data = bytearray(path.read_bytes())
    unequal_durations(data)
    path.write_bytes(data)
    frames = list(Footage([path]))
    np.testing.assert_allclose(np.diff([f.time_s for f in frames]), [0.04] * 10 + [0.16] * 9, atol=1e-6)
    for number in (17, 18, 3, 19, 3):
        image = read_frame_rgb(tmp_path / f"v.mp4#frame={number}")
        np.testing.assert_array_equal(image, frames[number].read_rgb())


def test_a_given_rate_replaces_the_videos_and_times_images(video, tmp_path):
    assert [f.time_s for f in Footage([video], 50.0)][:3] == pytest.approx([0, 0.02, 0.04])
    paths = [tmp_path / f"{i}.png" for i in (2, 1)]
    for path in paths:
        files.write_png(path, grey(int(path.stem)))
    frames = list(Footage(paths, 4.0))
    assert [(f.image, f.time_s) for f in frames] == [(paths[0], 0.0), (paths[1], 0.25)]
    assert [int(f.read_rgb()[0, 0, 0]) for f in frames] == [2, 1]
    assert [f.time_s for f in Footage(paths)] == [None, None]


def test_footage_that_cannot_be_read_is_named(video, tmp_path):
    with pytest.raises(InputError) as caught:
        Footage([video, tmp_path / "none.png", tmp_path / "gone.png"], 0.0)
    assert len(caught.value.problems) == 4
    assert all(word in str(caught.value) for word in ("none.png", "gone.png", "on its own", "--fps"))
    broken = tmp_path / "broken.mp4"
    broken.write_bytes(b"no video")
    with pytest.raises(InputError, match=r"broken\.mp4.*not a video"):
        Footage([broken])
    cut = tmp_path / "cut.avi"
    cut.write_bytes(video.read_bytes()[: video.stat().st_size * 3 // 4])
    assert 0 < len(list(Footage([cut], 12.5))) < 20


class SteadyPredictor:
    """A camera that moves by 1 mm a frame; frames 6 and 7 are refused, 12 is far off, found by their red."""

    estimator, meta = "dense", {}
    gives_covariance = True
    encoding = fit_encoding(np.eye(4)[None], np.zeros(3), 20.0)

    def __init__(self, *_):
        pass

    def predict(self, image, _camera):
        number = round((int(image[40, 40, 0]) - LEVELS.start) / LEVELS.step)
        x = number + (60.0 if number == 12 else 0.0)
        pose = look_at(np.array([x - 8, 5.0, 80.0]), np.array([x, 0, 0]), np.array([0, 1, 0]))
        covariance = np.diag([0.01**2] * 3 + [0.3**2] * 3)
        return Prediction(pose, number not in (6, 7), 0.99, 5.0, covariance)


@pytest.fixture
def case(tmp_path, monkeypatch):
    monkeypatch.setattr(predictor_module, "Predictor", SteadyPredictor)
    paths = write_inputs(tmp_path)
    return Case.create(tmp_path / "case", paths["vessels.vtp"], paths["cortex.vtp"], paths["camera.json"])


def test_register_writes_tracked_poses_beside_the_raw_ones(case, video, tmp_path, capsys):
    out = tmp_path / "out" / "poses.json"
    assert main(["register", str(case.folder), str(video), "--out", str(out), "--track"]) == 0
    assert "18 of 20 frames have a tracked pose" in capsys.readouterr().out
    stored_camera, frames = read_poses(out)
    assert stored_camera.matrix.tolist() == camera().matrix.tolist() and len(frames) == 20
    states = [frame.extra["tracking"]["state"] for frame in frames]
    assert (
        states
        == ["lost"] * 2 + ["tracking"] * 4 + ["coasting"] * 2 + ["tracking"] * 4 + ["coasting"] + ["tracking"] * 7
    )
    assert frames[0].extra["tracked_camera_from_world"] is None and frames[0].extra["tracking"]["covariance"] is None
    assert frames[5].extra["time_s"] == pytest.approx(0.4)
    assert np.shape(frames[3].extra["covariance"]) == np.shape(frames[3].extra["tracking"]["covariance"]) == (6, 6)
    true = SteadyPredictor().predict(grey(LEVELS[11]), None).camera_from_world[:3, 3] + [-1.0, 0, 0]
    tracked = np.array(frames[12].extra["tracked_camera_from_world"])[:3, 3]
    assert np.linalg.norm(frames[12].camera_from_world[:3, 3] - true) > 30 and np.linalg.norm(tracked - true) < 1


def test_register_without_track_is_as_before(case, video, tmp_path):
    out = tmp_path / "poses.json"
    assert main(["register", str(case.folder), str(video), "--out", str(out)]) == 0
    first = json.loads(out.read_text())["frames"][0]
    assert "tracking" not in first and first["image"] == "Op ä.avi#frame=0" and first["time_s"] == 0


def test_register_says_that_a_video_is_cut_short(case, video, tmp_path, capsys):
    cut = tmp_path / "cut.avi"
    cut.write_bytes(video.read_bytes()[: video.stat().st_size * 3 // 4])
    for path, said in ((video, False), (cut, True)):
        argv = ["register", str(case.folder), str(path), "--fps", "12.5", "--out", str(tmp_path / "poses.json")]
        assert main(argv) == 0
        assert ("of its 20 frames could be read" in capsys.readouterr().out) == said, path


def test_register_says_before_it_begins_that_its_file_cannot_be_written(case, video, tmp_path, capsys, monkeypatch):
    """After an hour's video its poses would be lost."""
    monkeypatch.setattr(SteadyPredictor, "predict", lambda *_: pytest.fail("registered for nothing"))
    places = (
        (tmp_path, "is a folder"),
        (video / "poses.json", "nothing can be written here"),
        (video, "would be replaced"),  # --out forgotten before the frames' names
    )
    for out, words in places:
        assert main(["register", str(case.folder), str(video), "--out", str(out)]) == 2
        assert words in capsys.readouterr().err


def test_frames_of_a_video_can_be_evaluated(case, video, tmp_path):
    registered, known = tmp_path / "registered.json", tmp_path / "known.json"
    assert main(["register", str(case.folder), str(video), "--out", str(registered)]) == 0
    stored_camera, frames = read_poses(registered)
    write_poses(known, stored_camera, [{"image": f.image, "camera_from_world": f.camera_from_world} for f in frames])
    out = tmp_path / "out"
    compare = ["evaluate", str(case.folder), "--poses", str(known), "--predicted", str(registered), "--out", str(out)]
    assert main(compare) == 0
    assert json.loads((out / "metrics.json").read_text())["add_mm"]["mean"] == 0
    overlays = [path.name for path in (out / "overlays").glob("*.png")]
    assert len(overlays) == 12 and "00_Op ä#frame=0.png" in overlays
    video.unlink()
    assert main(compare) == 2


@pytest.mark.skipif(sys.platform != "linux", reason="names are text elsewhere")
def test_names_that_are_no_text_are_registered_or_refused_and_crash_nothing(case, video, tmp_path, capsys):
    """Letters of another code page, as old archives and drives hold them: OpenCV crashed on such videos and captions,
    and poses.json could not be written when all frames were registered."""
    odd = os.fsdecode(b"M\xfcller")
    files.write_png(tmp_path / f"{odd}.png", grey(LEVELS[0]))
    out, files_of = tmp_path / "poses.json", [str(tmp_path / f"{odd}{suffix}") for suffix in (".png", ".avi", ".vtp")]
    assert main(["register", str(case.folder), files_of[0], "--out", str(out)]) == 0
    (frame,) = read_poses(out)[1]
    assert str(frame.image) == files_of[0]
    known = tmp_path / "known.json"
    write_poses(known, None, [{"image": frame.image, "camera_from_world": frame.camera_from_world}])
    compare = ["evaluate", str(case.folder), "--poses", str(known), "--predicted", str(out)]
    assert main([*compare, "--out", str(tmp_path / "evaluation")]) == 0
    capsys.readouterr()
    shutil.copy(video, files_of[1])
    assert main(["register", str(case.folder), files_of[1], "--out", str(out)]) == 2
    shutil.copy(tmp_path / "vessels.vtp", files_of[2])
    camera_path = str(tmp_path / "camera.json")
    assert main(["new", str(tmp_path / "b"), "--vessels", files_of[2], "--camera", camera_path]) == 0
    assert main(["new", str(tmp_path / odd), "--vessels", files_of[2], "--camera", camera_path]) == 2
    assert capsys.readouterr().err.count("not in UTF-8") == 2


def test_tracking_of_images_needs_their_rate_and_a_model_with_covariance(case, tmp_path, capsys, monkeypatch):
    paths = []
    for i, level in enumerate(LEVELS):
        paths.append(str(tmp_path / f"{i}.png"))
        files.write_png(paths[-1], grey(level))
    out = tmp_path / "poses.json"
    command = ["register", str(case.folder), *paths, "--out", str(out), "--track"]
    monkeypatch.setattr(SteadyPredictor, "gives_covariance", False)
    assert main(command) == 2
    text = capsys.readouterr().err
    assert "--fps" in text and "train" in text and not out.exists()
    monkeypatch.setattr(SteadyPredictor, "gives_covariance", True)
    assert main([*command, "--fps", "12.5"]) == 0
    assert [f.extra["tracking"]["state"] for f in read_poses(out)[1]].count("tracking") == 15
