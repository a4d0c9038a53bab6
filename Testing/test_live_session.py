"""The live session without MRML: sources, the newest-frame worker, trust, geometry of the overlay, poses by hand."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from pathlib import Path

import cases
import cv2
import numpy as np
import pytest

from ExpectedAppearancesLib import files
from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.geometry.camera import Camera
from ExpectedAppearancesLib.geometry.pose import look_at, transform
from ExpectedAppearancesLib.live import alignment, recording, sources
from ExpectedAppearancesLib.live.choice import Choice, SourceKind, open_source, problems_of
from ExpectedAppearancesLib.live.feed import Feed, FeedState
from ExpectedAppearancesLib.live.frames import FramePreparation, FrameSettings, picture_box
from ExpectedAppearancesLib.live.overlay import OverlayMaker, winding
from ExpectedAppearancesLib.live.steady import View
from ExpectedAppearancesLib.live.trust import Controls, Shown, Sight, controls, judge
from ExpectedAppearancesLib.live.worker import NewestWins
from ExpectedAppearancesLib.registration.predictor import Prediction

CAMERA = Camera(320, 240, 700.0, 690.0, 170.0, 108.0)
POSE = look_at(np.array([25.0, -18.0, 90.0]), np.array([1.0, 0.5, -2.0]), np.array([0.2, 1.0, 0.0]))


def noise(width=320, height=240, seed=0) -> np.ndarray:
    return np.random.default_rng(seed).integers(40, 255, (height, width, 3), dtype=np.uint8)


def within(seconds, condition):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        found = condition()
        if found:
            return found
        time.sleep(0.002)
    raise AssertionError("did not happen in time")


# ------------------------------------------------------------------------------------------------------------ worker


class Slow:
    """Work that goes on for as long as the test wants, and notices two at once."""

    def __init__(self):
        self.go, self.now, self.most, self.seen = threading.Semaphore(0), 0, 0, []

    def __call__(self, task):
        self.now += 1
        self.most = max(self.most, self.now)
        assert self.go.acquire(timeout=10)
        self.seen.append(task)
        self.now -= 1
        return task


def test_newest_wins_older_are_dropped_and_counted_and_one_is_in_flight():
    slow = Slow()
    worker = NewestWins(slow)
    worker.submit(0)
    within(5, lambda: slow.now == 1)
    for task in range(1, 10):
        worker.submit(task)
    assert worker.counts.dropped == 8 and worker.counts.in_flight == 1
    for _ in range(2):
        slow.go.release()
    within(5, lambda: worker.counts.done == 2)
    assert slow.seen == [0, 9] and slow.most == 1
    assert worker.take() == 9 and worker.take() is None
    counts = worker.counts
    assert (counts.submitted, counts.done, counts.dropped, counts.unseen, counts.in_flight) == (10, 2, 8, 1, 0)
    assert worker.stop()


def test_what_was_in_flight_when_it_was_forgotten_is_never_given_out():
    slow = Slow()
    worker = NewestWins(slow)
    worker.submit("old")
    within(5, lambda: slow.now == 1)
    worker.forget()
    slow.go.release()
    within(5, lambda: worker.counts.done == 1)
    assert worker.take() is None
    worker.submit("new")
    slow.go.release()
    assert worker.take(5) == "new"
    assert worker.stop()


def test_stopping_ends_the_thread_and_keeps_no_result():
    slow = Slow()
    worker = NewestWins(slow)
    worker.submit(1)
    within(5, lambda: slow.now == 1)
    assert not worker.stop(0.05)
    slow.go.release()
    assert worker.stop(5)
    assert worker.take() is None
    worker.submit(2)
    assert worker.counts.submitted == 1


def test_a_fault_in_the_work_is_kept_and_the_work_goes_on():
    def process(task):
        if task == 0:
            raise ZeroDivisionError("x")
        return task

    worker = NewestWins(process)
    worker.submit(0)
    within(5, lambda: worker.failure)
    worker.submit(1)
    assert worker.take(5) == 1
    assert worker.stop()


# ----------------------------------------------------------------------------------------------------------- sources


def read_all(source, count, seconds=10.0):
    found, end = [], time.monotonic() + seconds
    while len(found) < count and time.monotonic() < end:
        frame = source.read()
        if frame is not None:
            found.append(frame)
        time.sleep(0.001)
    return found


def write_images(folder, names):
    for i, name in enumerate(names):
        files.write_png(folder / name, noise(seed=i))


def test_folder_is_read_in_the_order_of_its_numbers(tmp_path):
    write_images(tmp_path, ["f_10.png", "f_9.png", "f_1.png"])
    source = sources.ImageFiles(tmp_path, rate_hz=1000)
    source.open()
    assert [frame.name for frame in read_all(source, 3)] == ["f_1.png", "f_9.png", "f_10.png"]


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp"])
def test_a_file_is_taken_only_when_it_is_whole(tmp_path, suffix):
    image = noise()
    data = cv2.imencode(suffix, image[..., ::-1])[1].tobytes()
    now = [0.0]
    source = sources.ImageFiles(tmp_path, rate_hz=1000, clock=lambda: now[0])
    source.open()
    path = tmp_path / f"a{suffix}"
    for share in (0.3, 0.6, 0.9):
        path.write_bytes(data[: int(len(data) * share)])
        now[0] += 0.1
        assert source.read() is None
    path.write_bytes(data)
    now[0] += 0.1
    found = source.read()
    if found is None:  # a format without a mark at its end has to stand still for a moment
        now[0] += 0.3
        found = source.read()
    assert found.image_rgb.shape == image.shape
    if suffix != ".jpg":
        np.testing.assert_array_equal(found.image_rgb, image)


def test_a_file_that_never_gets_whole_is_said_and_left_out(tmp_path):
    write_images(tmp_path, ["b.png"])
    (tmp_path / "a.png").write_bytes((tmp_path / "b.png").read_bytes()[:200])
    now = [0.0]
    source = sources.ImageFiles(tmp_path, rate_hz=1000, clock=lambda: now[0])
    source.open()
    assert source.read() is None
    now[0] += 3
    with pytest.raises(InputError, match=r"a\.png: damaged"):
        source.read()
    now[0] += 1
    assert source.read().name == "b.png"


def test_only_new_images_of_a_folder(tmp_path):
    write_images(tmp_path, ["1.png"])
    source = sources.ImageFiles(tmp_path, rate_hz=1000, only_new=True)
    source.open()
    assert source.read() is None
    write_images(tmp_path, ["2.png"])
    assert read_all(source, 1)[0].name == "2.png"


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    """Twenty frames at 50 per second, each of its own grey."""
    path = tmp_path_factory.mktemp("video") / "v.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 50.0, (64, 48))
    for i in range(20):
        writer.write(np.full((48, 64, 3), (10 * i, 0, 200), np.uint8))
    writer.release()
    return path


def test_video_plays_at_its_speed_in_rgb_and_ends(video):
    now = [0.0]
    source = sources.VideoFile(video, clock=lambda: now[0])
    source.open()
    first = source.read()
    assert source.read() is None  # not due yet
    red, _green, blue = first.image_rgb[20, 20]
    assert red > 180 and blue < 20
    now[0] += 5 / 50
    later = source.read()
    assert later.number == 4 + source.dropped - 3  # late frames are left out and counted
    assert abs(int(later.image_rgb[20, 20, 2]) - 10 * later.number) < 8
    assert source.dropped >= 3
    now[0] += 10
    with pytest.raises(sources.SourceEnded):
        for _ in range(30):
            now[0] += 0.02
            source.read()
    source.close()


def test_video_begins_again(video):
    now = [0.0]
    source = sources.VideoFile(video, repeat=True, clock=lambda: now[0])
    source.open()
    seen = 0
    for _ in range(60):
        now[0] += 0.02
        seen += source.read() is not None
    assert seen > 40
    source.close()


def test_files_that_are_no_video_are_said(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"nothing")
    with pytest.raises(InputError, match="not a video"):
        sources.VideoFile(tmp_path / "a.mp4").open()
    with pytest.raises(sources.SourceLost, match="not found"):
        sources.VideoFile(tmp_path / "b.mp4").open()


class FakeCapture:
    """A capture device that can be unplugged."""

    plugged = True

    def __init__(self, _device):
        pass

    def isOpened(self):
        return type(self).plugged

    def set(self, *_):
        return True

    def read(self):
        time.sleep(0.002)
        return (True, noise()) if type(self).plugged else (False, None)

    def release(self):
        pass


def test_feed_says_that_the_device_is_lost_and_returns_with_it(monkeypatch):
    monkeypatch.setattr(cv2, "VideoCapture", FakeCapture)
    monkeypatch.setattr(FakeCapture, "plugged", True)
    frames = []
    feed = Feed(sources.CaptureDevice(0), frames.append, retry_s=0.02)
    feed.start()
    within(5, lambda: len(frames) > 3)
    assert feed.status.state is FeedState.RUNNING
    FakeCapture.plugged = False
    within(5, lambda: feed.status.state is FeedState.LOST)
    assert "capture device 0" in feed.status.problem
    before = len(frames)
    FakeCapture.plugged = True
    within(5, lambda: len(frames) > before + 3)
    assert feed.status.state is FeedState.RUNNING and not feed.status.problem
    assert feed.stop()
    after = len(frames)
    time.sleep(0.05)
    assert len(frames) == after


def test_feed_ends_after_the_last_file_and_survives_a_driver_that_fails(tmp_path):
    write_images(tmp_path, ["1.png", "2.png"])
    frames = []
    feed = Feed(sources.ImageFiles([tmp_path / "1.png", tmp_path / "2.png"], rate_hz=500), frames.append)
    feed.start()
    within(5, lambda: feed.status.state is FeedState.ENDED)
    assert [frame.name for frame in frames] == ["1.png", "2.png"]

    class Broken(sources.ImageFiles):
        def read(self):
            raise RuntimeError("driver")

    feed = Feed(Broken([tmp_path / "1.png"]), frames.append)
    feed.start()
    within(5, lambda: feed.status.state is FeedState.LOST)
    assert "driver" in feed.status.problem
    assert feed.stop()


def test_a_folder_that_vanishes_is_said_and_found_again(tmp_path):
    folder = tmp_path / "share"
    folder.mkdir()
    write_images(folder, ["1.png"])
    frames = []
    feed = Feed(sources.ImageFiles(folder, rate_hz=500), frames.append, retry_s=0.02)
    feed.start()
    within(5, lambda: frames)
    (folder / "1.png").unlink()
    folder.rmdir()
    within(5, lambda: feed.status.state is FeedState.LOST)
    folder.mkdir()
    write_images(folder, ["2.png"])
    within(5, lambda: len(frames) == 2)
    assert feed.stop()


def test_choice_lists_all_that_is_missing_and_opens_what_is_there(tmp_path, video):
    found = problems_of(Choice(path=str(tmp_path / "none"), camera_path=str(tmp_path / "c.json")))
    assert len(found) == 3 and "case" in found[0] and "none" in found[1] and "c.json" in found[2]
    (tmp_path / "a.txt").write_text("x")
    assert "not a kind of file" in problems_of(Choice(path=str(tmp_path / "a.txt")))[-1]
    assert "number of the capture device" in problems_of(Choice(kind=SourceKind.DEVICE, device=" "))[-1]
    assert "Choose the volume" in problems_of(Choice(kind=SourceKind.NODE))[-1]
    assert isinstance(open_source(Choice(path=str(tmp_path))).source, sources.ImageFiles)
    assert isinstance(open_source(Choice(path=str(video))).source, sources.VideoFile)
    write_images(tmp_path, ["1.png"])
    assert open_source(Choice(path=str(tmp_path / "1.png"))).still
    with pytest.raises(InputError, match=r"a\.txt"):
        open_source(Choice(path=str(tmp_path / "a.txt")))


# ------------------------------------------------------------------------------------------------------------ frames


def projected_marks(camera, points_mm, radius=3) -> np.ndarray:
    """A frame of `camera` with bright discs where it sees the points; the rest dark grey."""
    image = np.full((camera.height, camera.width, 3), 60, np.uint8)
    for u, v in camera.project(points_mm):
        cv2.circle(image, (round(u * 16), round(v * 16)), radius * 16, (255, 255, 255), -1, cv2.LINE_AA, 4)
    return image


def seen_marks(image) -> np.ndarray:
    """Centres of the bright discs, px, by rows."""
    bright = np.clip(image[..., 1].astype(float) - 90, 0, None)
    _n, labels = cv2.connectedComponents((bright > 30).astype(np.uint8))
    ys, xs = np.mgrid[: image.shape[0], : image.shape[1]]
    found = []
    for label in range(1, labels.max() + 1):
        weight = bright * (cv2.dilate((labels == label).astype(np.uint8), np.ones((3, 3))) > 0)
        found.append([(xs * weight).sum() / weight.sum(), (ys * weight).sum() / weight.sum()])
    return np.array(sorted(found))


POINTS_MM = np.array([[-30, -22, 300], [-8, 15, 310], [12, -12, 295], [25, 18, 305.0]])


@pytest.mark.parametrize(
    "camera, settings, borders",
    [
        (Camera(640, 480, 1800, 1750, 340, 215), FrameSettings(longest_px=4000), None),
        (Camera(640, 480, 1800, 1750, 340, 215), FrameSettings(longest_px=333), None),
        (Camera(640, 480, 1800, 1750, 340, 215, (-2.0, 5.0, 0.003, -0.002, 0.0)), FrameSettings(longest_px=500), None),
        (Camera(640, 480, 1800, 1750, 340, 215), FrameSettings(crop_borders=True, longest_px=400), "kept"),
        (Camera(640, 480, 1800, 1750, 340, 215, (-2.0, 5.0, 0, 0, 0)), FrameSettings(crop_borders=True), "added"),
    ],
    ids=["as it is", "scaled", "undistorted", "borders in A", "borders not in A"],
)
def test_the_prepared_camera_sees_each_point_where_the_prepared_frame_has_it(camera, settings, borders):
    image = projected_marks(camera, POINTS_MM)
    if borders == "kept":  # calibrated with the black bars
        image[:, :70], image[:, -60:], image[:30] = 0, 0, 0
    elif borders == "added":  # calibrated without them
        image = cv2.copyMakeBorder(image, 0, 0, 120, 90, cv2.BORDER_CONSTANT, value=(0, 0, 0))
    prepared, ideal = FramePreparation(camera, settings).prepare(image)
    assert prepared.shape == (ideal.height, ideal.width, 3) and not ideal.is_distorted
    if borders == "kept":
        assert (ideal.width / ideal.height) == pytest.approx(510 / 450, rel=0.01)
    expected = ideal.project(POINTS_MM)
    inside = ((expected > 5) & (expected < [ideal.width - 6, ideal.height - 6])).all(axis=1)
    assert inside.sum() >= 3
    expected = np.array(sorted(expected[inside].tolist()))
    np.testing.assert_allclose(seen_marks(prepared), expected, atol=0.35)


def test_frames_that_come_upside_down_are_turned():
    image = noise()
    prepared, _camera = FramePreparation(CAMERA, FrameSettings(flip_rows=True)).prepare(image[::-1])
    np.testing.assert_array_equal(prepared, image)


def test_a_dark_moment_cuts_nothing_off():
    preparation = FramePreparation(CAMERA, FrameSettings(crop_borders=True))
    bright, dark = noise(), noise()
    bright[:, :40] = 0
    dark[:, :200] = 0
    assert preparation.prepare(bright)[1].width == 280
    assert preparation.prepare(dark)[1].width == 280
    assert picture_box(np.zeros((240, 320, 3), np.uint8)) == (0, 0, 320, 240)


@pytest.mark.parametrize(
    "image, words",
    [
        (np.zeros((240, 320, 3), np.float32), "float32"),
        (np.zeros((240, 320, 3), np.uint8), "blank"),
        (noise(320, 200), "aspect ratio"),
        (noise(20, 15), "at least"),
        (None, "NoneType"),
    ],
)
def test_what_is_no_picture_is_said(image, words):
    with pytest.raises(InputError, match=words):
        FramePreparation(CAMERA).prepare(image)


# ------------------------------------------------------------------------------------------------------------- trust

NOW, STALE = 100.0, 0.5


def shown(age=0.1, accepted=True, key="this", problem="", view=None):
    return Shown(NOW - age, key, accepted, 0.9, problem, view)


@pytest.mark.parametrize(
    "sight, arguments",
    [
        (Sight.FOLLOWING, {"shown": shown()}),
        (Sight.FOLLOWING, {"shown": shown(age=STALE)}),
        (Sight.STALE, {"shown": shown(age=STALE + 0.01)}),
        (Sight.STALE, {"shown": shown(age=float("nan"))}),
        (Sight.REFUSED, {"shown": shown(accepted=False)}),
        (Sight.FOLLOWING, {"shown": shown(view=View.FOLLOWING)}),
        (Sight.FOUND, {"shown": shown(view=View.FOUND)}),
        (Sight.REFUSED, {"shown": shown(accepted=False, view=View.DOUBTED)}),
        (Sight.REFUSED, {"shown": shown(accepted=False, view=View.FOUND)}),
        (Sight.VIEW_LOST, {"shown": shown(accepted=False, view=View.LOST)}),
        (Sight.STALE, {"shown": shown(age=2, view=View.FOUND)}),
        (Sight.FROZEN, {"shown": shown(view=View.FOUND), "frozen": True}),
        (Sight.OTHER_CASE, {"shown": shown(key="other")}),
        (Sight.OTHER_CASE, {"shown": shown(key="other"), "frozen": True}),
        (Sight.UNUSABLE, {"shown": shown(problem="blank", accepted=False)}),
        (Sight.UNUSABLE, {"shown": shown(problem="blank"), "frozen": True}),
        (Sight.WAITING, {"shown": None}),
        (Sight.LOST, {"shown": None, "feed": FeedState.LOST}),
        (Sight.LOST, {"shown": shown(age=2), "feed": FeedState.LOST}),
        (Sight.FOLLOWING, {"shown": shown(age=0.1), "feed": FeedState.LOST}),
        (Sight.STALE, {"shown": shown(age=2), "feed": FeedState.ENDED}),
        (Sight.FROZEN, {"shown": shown(age=500), "frozen": True}),
        (Sight.REFUSED, {"shown": shown(age=500, accepted=False), "frozen": True}),
        (Sight.IDLE, {"shown": shown(), "running": False}),
        (Sight.FAILED, {"shown": shown(), "failure": "ValueError: x"}),
        (Sight.FAILED, {"shown": shown(), "failure": "x", "frozen": True}),
    ],
)
def test_trust_as_a_table(sight, arguments):
    verdict = judge(**({"now_s": NOW, "case_key": "this", "stale_s": STALE, "running": True} | arguments))
    assert verdict.sight is sight
    assert verdict.shows_overlay == (sight in (Sight.FOLLOWING, Sight.FOUND, Sight.FROZEN))


def test_controls_as_a_table():
    def can(**values):
        usual = dict.fromkeys(("ready", "running", "frozen", "has_frame", "aligning", "recording"), False)
        return controls(**(usual | values))

    assert can() == Controls(True, False, False, False, False, False, False)
    assert can(ready=True) == Controls(True, True, False, False, True, False, False)
    assert can(ready=True, running=True) == Controls(False, False, True, False, True, True, False)
    live = {"ready": True, "running": True, "has_frame": True}
    assert can(**live) == Controls(False, False, True, True, True, True, False)
    assert can(**live, frozen=True).align and not can(**live).align
    assert not can(**live, frozen=True, aligning=True).freeze
    assert not can(**live, recording=True).single


# ----------------------------------------------------------------------------------------------------------- overlay


def test_fill_is_the_same_as_opencv_fills_triangle_by_triangle():
    mesh = cases.vessels()
    pose = POSE
    overlay = OverlayMaker(mesh).make(CAMERA, pose)
    pixels = CAMERA.project(transform(pose, mesh.vertices_mm))
    expected = np.zeros((240, 320), np.uint8)
    for triangle in pixels[mesh.triangles]:
        cv2.fillConvexPoly(expected, np.rint(triangle * 256).astype(int), 1, cv2.LINE_8, 8)
    # OpenCV also fills the pixels that a triangle's side only touches: a rim of one pixel.
    assert not (overlay.fill.astype(bool) & ~expected.astype(bool)).any()
    assert not (cv2.erode(expected, np.ones((3, 3))).astype(bool) & ~overlay.fill.astype(bool)).any()
    assert overlay.fill.sum() > 2000


def test_winding_counts_overlaps_and_cuts_what_lies_outside():
    square = np.array([[2, 1], [2, 6], [7, 6], [7, 1.0]])
    edges = np.stack([square, np.roll(square, -1, axis=0)], axis=1)
    shifted = edges + np.array([3.0, 2.0])
    both = winding(np.concatenate([edges, shifted]), np.ones(8), 9, 8)
    expected = np.zeros((8, 9), int)
    expected[1:6, 2:7] += 1
    expected[3:8, 5:10] += 1
    np.testing.assert_array_equal(np.abs(both), expected)
    np.testing.assert_array_equal(winding(edges - 20, np.ones(4), 9, 8), 0)


def test_nothing_is_drawn_of_vessels_behind_the_camera():
    assert OverlayMaker(cases.vessels()).make(CAMERA, np.diag([1.0, -1, -1, 1]) @ POSE) is None


# --------------------------------------------------------------------------------------------------------- alignment


def test_landmarks_give_the_pose_and_say_how_well():
    points = cases.vessels().vertices_mm[::40][:8]
    pixels = CAMERA.project(transform(POSE, points))
    found = alignment.pose_from_landmarks(pixels, points, CAMERA)
    np.testing.assert_allclose(found.camera_from_world, POSE, atol=1e-5)
    assert found.rms_px < 1e-4
    shaken = pixels + np.random.default_rng(0).normal(0, 0.5, pixels.shape)
    found = alignment.pose_from_landmarks(shaken, points, CAMERA)
    again = CAMERA.project(transform(found.camera_from_world, points))
    np.testing.assert_allclose(found.errors_px, np.linalg.norm(again - shaken, axis=1))
    assert found.rms_px < 0.8


@pytest.mark.parametrize(
    "points, pixels, words",
    [
        (np.eye(3), np.eye(3)[:, :2], "at least 4"),
        (np.eye(5, 3), np.eye(4, 2), "5 on the mesh"),
        (np.outer(np.arange(5), [1, 2, 3]), np.random.default_rng(0).uniform(0, 200, (5, 2)), "one line"),
    ],
)
def test_landmarks_that_cannot_give_a_pose_are_refused(points, pixels, words):
    with pytest.raises(InputError, match=words):
        alignment.pose_from_landmarks(pixels, points, CAMERA)


def test_sliders_move_the_vessels_as_their_names_say():
    pivot = cases.vessels().centroid_mm
    moved = alignment.nudged(POSE, pivot, np.array([2.0, -1.0, 5.0]), np.zeros(3))
    np.testing.assert_allclose((moved - POSE)[:3, 3], [2, -1, 5])
    rolled = alignment.nudged(POSE, pivot, np.zeros(3), np.array([0, 0, 90.0]))
    np.testing.assert_allclose(transform(rolled, pivot[None]), transform(POSE, pivot[None]), atol=1e-9)
    right = transform(POSE, pivot[None]) + np.array([1.0, 0, 0])
    world = transform(np.linalg.inv(POSE), right)
    down = transform(rolled, world) - transform(rolled, pivot[None])
    np.testing.assert_allclose(down, [[0, 1, 0]], atol=1e-9)  # a quarter turn clockwise in the frame
    both = alignment.nudged(POSE, pivot, np.array([3.0, 1, -2]), np.array([10.0, -5, 20]))
    shift, turn = alignment.nudge_between(POSE, both, pivot)
    np.testing.assert_allclose(shift, [3, 1, -2], atol=1e-9)
    np.testing.assert_allclose(turn, [10, -5, 20], atol=1e-9)


def test_difference_of_poses():
    vertices = cases.vessels().vertices_mm
    moved = POSE.copy()
    moved[0, 3] += 2.0
    found = alignment.compare(vertices, POSE, moved, CAMERA)
    assert found.add_mm == pytest.approx(2.0) and found.translation_mm == pytest.approx(2.0)
    assert found.rotation_deg == pytest.approx(0, abs=1e-6)
    assert found.reprojection_px == pytest.approx(np.mean(2 * CAMERA.fx / transform(POSE, vertices)[:, 2]), rel=1e-6)


# --------------------------------------------------------------------------------------------------------- recording


def test_notes_come_back_exactly_and_foreign_ones_are_refused():
    frame = recording.RecordedFrame(1.25, "ä 7", CAMERA, Prediction(POSE / 1.0, True, 0.123456789, 12.5))
    again, key = recording.from_note(recording.to_note(frame, "abc"))
    assert key == "abc" and again.name == "ä 7" and again.time_s == 1.25
    np.testing.assert_array_equal(again.prediction.camera_from_world, POSE)
    assert again.prediction.confidence == 0.123456789 and again.prediction.accepted
    unknown = recording.RecordedFrame(0.0, "b", CAMERA, Prediction(POSE, True, float("nan"), 0.0))
    assert np.isnan(recording.from_note(recording.to_note(unknown, "abc"))[0].prediction.confidence)
    for text in ("", "{}", '{"format": "x"}', recording.to_note(frame, "abc").replace("true", '"yes"')):
        if "yes" in text:
            assert not recording.from_note(text)[0].prediction.accepted
        else:
            with pytest.raises(InputError, match="record again"):
                recording.from_note(text)


def test_export_refuses_a_change_of_camera_and_an_empty_recording(tmp_path):
    frame = recording.RecordedFrame(0.0, "a", CAMERA, Prediction(POSE, True, 1.0, 1.0), noise())
    other = recording.RecordedFrame(
        0.0, "b", CAMERA.resized(160, 120), Prediction(POSE, True, 1.0, 1.0), noise(160, 120)
    )
    with pytest.raises(InputError, match="another size or camera"):
        recording.export_recording(tmp_path / "a", [frame, other])
    assert not (tmp_path / "a" / "poses.json").exists()
    with pytest.raises(InputError, match="no frame"):
        recording.export_recording(tmp_path / "b", [])


def test_the_panel_loads_without_what_it_offers_to_install():
    code = (
        "import sys\n"
        "for name in ('cv2', 'onnxruntime', 'torch', 'scipy', 'matplotlib', 'skimage'): sys.modules[name] = None\n"
        "import ExpectedAppearancesLib.mrml.live_controller, ExpectedAppearancesLib.live.choice\n"
    )
    root = str(Path(__file__).resolve().parents[1])
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
