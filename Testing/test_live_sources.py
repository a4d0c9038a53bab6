"""Where live frames come from: files, folders that are being filled, videos, devices, and their thread."""

from __future__ import annotations

import time

import cv2
import numpy as np
import pytest

from ExpectedAppearancesLib import files
from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.geometry.camera import Camera
from ExpectedAppearancesLib.geometry.pose import look_at
from ExpectedAppearancesLib.live import sources
from ExpectedAppearancesLib.live.choice import Choice, SourceKind, open_source, problems_of
from ExpectedAppearancesLib.live.feed import Feed, FeedState
from ExpectedAppearancesLib.registration.footage import VIDEO_SUFFIXES
from ExpectedAppearancesLib.registration.poses_file import write_poses


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
    """A digit that is no number, such as the square, ended the source."""
    write_images(tmp_path, ["f_10.png", "f_9.png", "f_1.png", "f_10²3.png"])
    source = sources.ImageFiles(tmp_path, rate_hz=1000)
    source.open()
    assert [frame.name for frame in read_all(source, 4)] == ["f_1.png", "f_9.png", "f_10.png", "f_10²3.png"]


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


@pytest.mark.parametrize("only_new", [False, True])
def test_a_folder_of_thousands_is_not_sorted_for_each_image(tmp_path, monkeypatch, only_new):
    """Looking for the next image took longer than to register one, again and again while none came."""
    data = cv2.imencode(".png", noise(40, 32))[1].tobytes()
    for i in range(50):
        (tmp_path / f"{i}.png").write_bytes(data)
    source = sources.ImageFiles(tmp_path, rate_hz=1000, only_new=only_new)
    source.open()
    looked_at = []
    in_order = files.natural_order
    monkeypatch.setattr(files, "natural_order", lambda name: looked_at.append(name) or in_order(name))
    if only_new:
        (tmp_path / "50.png").write_bytes(data)
    names = ["50.png"] if only_new else [f"{i}.png" for i in range(50)]
    assert [frame.name for frame in read_all(source, len(names))] == names
    assert read_all(source, 1, 0.05) == [] and len(looked_at) == len(names)


@pytest.mark.parametrize("suffix", [".png", ".bmp"])
def test_a_folder_that_is_filled_faster_than_it_is_shown_stays_in_the_present(tmp_path, suffix):
    """Shown one by one, the pictures were ever older, and as new as if they had just been taken; so after a pause."""
    data = cv2.imencode(suffix, noise(40, 32))[1].tobytes()
    now, shown, written = [0.0], [], 0

    def write_up_to(number):
        nonlocal written
        while written < number:
            written += 1
            (tmp_path / f"{written}{suffix}").write_bytes(data)

    write_up_to(5)
    source = sources.ImageFiles(tmp_path, rate_hz=10, clock=lambda: now[0])
    source.open()
    for step in range(200):
        now[0] += 0.05
        if step >= 50:
            write_up_to(5 + 2 * (step - 49))  # 40 a second
        frame = source.read()
        if frame is not None:
            shown.append(int(frame.name.split(".")[0]))
            assert shown[-1] <= 5 or written - shown[-1] < 25
    assert shown[:5] == [1, 2, 3, 4, 5]  # those that were there
    assert shown == sorted(shown) and len(shown) > 20
    assert source.dropped + len(shown) > written - 25


def test_an_image_that_is_taken_away_before_its_turn_does_not_hold_up_the_others(tmp_path):
    write_images(tmp_path, ["1.png", "2.png", "3.png"])
    now = [0.0]
    source = sources.ImageFiles(tmp_path, rate_hz=1000, clock=lambda: now[0])
    source.open()
    assert source.read().name == "1.png"
    (tmp_path / "2.png").unlink()
    now[0] += 0.01
    assert source.read() is None
    assert source.read().name == "3.png"


@pytest.mark.parametrize("why", ["pause", "deleted", "lost"])
def test_what_was_found_in_a_folder_before_a_pause_is_not_the_present(tmp_path, why):
    """Steps through a folder that is being filled showed every second time a picture of the step before, as new; where
    its maker had deleted that, or the drive was away, all that had come since were shown one by one."""
    folder, now = tmp_path / "frames", [0.0]
    folder.mkdir()
    source = sources.ImageFiles(folder, rate_hz=25, only_new=True, clock=lambda: now[0])
    source.open()
    assert source.read() is None
    write_images(folder, [f"{i}.png" for i in range(1, 5)])
    now[0] += 1
    assert source.read().name == "3.png"
    now[0] += 60
    if why == "lost":
        folder = folder.rename(tmp_path / "away")
        with pytest.raises(sources.SourceLost):
            read_all_of(source, now)
        source.close()
        folder = folder.rename(tmp_path / "frames")
    elif why == "deleted":
        (folder / "4.png").unlink()
    write_images(folder, [f"{i}.png" for i in range(5, 20)])
    if why == "lost":
        source.open()
    elif why == "pause":
        source.go_on()
    assert read_all_of(source, now) == ["18.png", "19.png"]


def read_all_of(source, now) -> list:
    names = []
    for _step in range(20):
        now[0] += 0.1
        frame = source.read()
        names += [frame.name] if frame is not None else []
    return names


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


def test_an_image_whose_header_is_nonsense_is_said_and_left_out(tmp_path):
    """Of a size that OpenCV does not just decline, but raises its own error for."""
    write_images(tmp_path, ["b.png"])
    header = bytearray(cv2.imencode(".bmp", noise())[1].tobytes())
    header[18:26] = (200000).to_bytes(4, "little") * 2
    (tmp_path / "a.bmp").write_bytes(header)
    came = []
    feed = Feed(sources.ImageFiles(tmp_path, rate_hz=1000), came.append)
    feed.start()
    within(10, lambda: came or feed.status.state is FeedState.LOST)
    assert feed.stop() and [frame.name for frame in came] == ["b.png"]


def test_only_new_images_of_a_folder(tmp_path):
    write_images(tmp_path, ["1.png"])
    source = sources.ImageFiles(tmp_path, rate_hz=1000, only_new=True)
    source.open()
    assert source.read() is None
    write_images(tmp_path, ["2.png"])
    assert read_all(source, 1)[0].name == "2.png"


def test_repeating_only_new_images_leaves_the_old_ones_out(tmp_path):
    write_images(tmp_path, ["1.png"])
    source = sources.ImageFiles(tmp_path, rate_hz=1000, only_new=True, repeat=True)
    source.open()
    assert read_all(source, 1, 0.05) == []
    write_images(tmp_path, ["2.png"])
    assert [frame.name for frame in read_all(source, 3)] == ["2.png"] * 3


@pytest.mark.parametrize("kind", ["folder", "dangling link"])
def test_what_cannot_be_read_does_not_hold_up_the_images_after_it(tmp_path, kind):
    write_images(tmp_path, ["b.png"])
    if kind == "folder":
        (tmp_path / "a.png").mkdir()
    else:
        try:
            (tmp_path / "a.png").symlink_to(tmp_path / "gone.png")
        except OSError:
            pytest.skip("no links here")
    now = [0.0]
    source = sources.ImageFiles(tmp_path, rate_hz=1000, clock=lambda: now[0])
    source.open()
    assert source.read() is None  # its writer may have locked it
    now[0] += 3
    with pytest.raises(InputError, match=r"a\.png: cannot be read"):
        source.read()
    now[0] += 1
    assert source.read().name == "b.png"


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


def test_poses_of_a_videos_frames_are_shown_with_the_video(video):
    """As `register` writes them."""
    poses = [look_at(np.array([0.0, i, 90.0]), np.zeros(3), np.array([0.0, 1.0, 0.0])) for i in range(20)]
    names = [video.with_name(f"v.avi#frame={i}") for i in range(20)]
    entries = [{"image": name, "camera_from_world": pose} for name, pose in zip(names, poses)]
    write_poses(video.parent / "poses.json", Camera(64, 48, 90.0, 90.0, 31.5, 23.5), entries)
    opened = open_source(Choice(path=str(video.parent / "poses.json"), repeat=True))
    assert opened.camera.width == 64
    now = [0.0]
    opened.source._clock = lambda: now[0]
    opened.source.open()
    seen = []
    while len(seen) < 50:
        now[0] += 0.02
        frame = opened.source.read()
        if frame is not None:
            seen.append(round(int(frame.image_rgb[20, 20, 2]) / 10))
            np.testing.assert_allclose(frame.given.camera_from_world, poses[seen[-1]])
    assert set(seen) >= set(range(18))
    opened.source.close()
    (video.parent / "poses.json").unlink()


class FakeCapture:
    """A capture device that can be unplugged."""

    plugged = True

    def __init__(self, _device):
        pass

    def isOpened(self):
        return type(self).plugged

    size = (320, 240)  # what drivers start with is rarely what they can

    def set(self, what, value):
        if what in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT):
            width, height = self.size
            self.size = (int(value), height) if what == cv2.CAP_PROP_FRAME_WIDTH else (width, int(value))
        return True

    def read(self):
        time.sleep(0.002)
        return (True, noise(*self.size)) if type(self).plugged else (False, None)

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


def test_a_device_is_asked_for_the_size_that_the_camera_was_calibrated_with(monkeypatch):
    """Drivers start with 640 x 480, which is another shape than most microscopes' pictures."""
    monkeypatch.setattr(cv2, "VideoCapture", FakeCapture)
    choice = Choice(kind=SourceKind.DEVICE, device="0")
    for camera, size in ((Camera(384, 216, 700, 700, 191.5, 107.5), (384, 216)), (None, (320, 240))):
        source = open_source(choice, camera).source
        source.open()
        assert source.read().image_rgb.shape[1::-1] == size
        source.close()


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


def test_why_the_only_image_is_not_shown_is_still_said_at_the_end(tmp_path):
    """The panel waited for a picture without a word."""
    (tmp_path / "a.png").write_bytes(b"no picture, and yet its end: IEND")
    feed = Feed(sources.ImageFiles([tmp_path / "a.png"]), lambda _frame: None)
    feed.start()
    within(5, lambda: feed.status.state is FeedState.ENDED)
    assert "a.png: not an image" in feed.status.problem
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


def test_a_network_drive_that_is_lost_is_tried_again(tmp_path, video, vanish):
    """Its answer to every look is an error of the system, which ended the feed for good, and each look of the panel."""
    write_images(tmp_path, ["1.png"])
    chosen = [tmp_path, video, tmp_path / "poses.json"]
    folder = sources.ImageFiles(tmp_path)
    folder.open()
    vanish(tmp_path)
    vanish(video.parent)
    with pytest.raises(sources.SourceLost, match="cannot be read"):
        folder.read()
    for source in (folder, sources.VideoFile(video)):
        with pytest.raises(sources.SourceLost, match="wait for its drive"):
            source.open()
    for path in chosen:
        found = problems_of(Choice(case_path=str(tmp_path / "case"), path=str(path), camera_path=str(tmp_path / "c")))
        assert len(found) == 3 and "not a case" in found[0] and "its drive" in found[1], found


def test_choice_lists_all_that_is_missing_and_opens_what_is_there(tmp_path, video):
    found = problems_of(Choice(path=str(tmp_path / "none"), camera_path=str(tmp_path / "c.json")))
    assert len(found) == 3 and "case" in found[0] and "none" in found[1] and "c.json" in found[2]
    (tmp_path / "a.txt").write_text("x")
    assert "not a kind of file" in problems_of(Choice(path=str(tmp_path / "a.txt")))[-1]
    assert "number of the capture device" in problems_of(Choice(kind=SourceKind.DEVICE, device=" "))[-1]
    assert "Choose the volume" in problems_of(Choice(kind=SourceKind.NODE))[-1]
    assert isinstance(open_source(Choice(path=str(tmp_path))).source, sources.ImageFiles)
    assert isinstance(open_source(Choice(path=str(video))).source, sources.VideoFile)
    for suffix in VIDEO_SUFFIXES:  # all that `register` takes, as the .mts of many recorders
        path = tmp_path / f"video{suffix}"
        path.write_bytes(b"")
        assert isinstance(open_source(Choice(path=str(path))).source, sources.VideoFile)
        assert "not a kind of file" not in problems_of(Choice(path=str(path)))[-1]
    write_images(tmp_path, ["1.png"])
    assert open_source(Choice(path=str(tmp_path / "1.png"))).still
    with pytest.raises(InputError, match=r"a\.txt"):
        open_source(Choice(path=str(tmp_path / "a.txt")))
