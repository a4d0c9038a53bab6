"""Recording into sequences with a browser: the frame, its CameraToRAS, and a note with confidence, time and pose.

All is saved with the scene by Slicer itself. Replaying puts a frame, its transform and its note back together.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..case.case import Case
from ..errors import InputError
from ..geometry.pose import camera_to_ras
from ..live.recording import RecordedFrame, export_recording, from_note, to_note
from ..live.session import LiveResult
from . import scene as scenes
from .live_nodes import ROLE_ATTRIBUTE, SEQUENCE_ATTRIBUTE, browsers, node_of_role, nodes_of_class
from .live_scene import FRAME, TRANSFORM, LiveScene
from .live_stream import pixels_of

NOTE = "note"
BROWSER_ATTRIBUTE = "ExpectedAppearances.Recording"
BROWSER_NAME = "Microscope recording"
DEFAULT_LIMIT_MB = 2048


class Recorder:
    """Appends results to new sequences until it is full. The nodes belong to the scene; nothing is kept here."""

    def __init__(self, live_scene: LiveScene, limit_mb: float = DEFAULT_LIMIT_MB):
        self._live, self._limit_mb = live_scene, limit_mb
        self._scene = live_scene._scene
        self._begin_s: float | None = None
        self.mb = 0.0
        self.frames = 0
        self.sequences = {}
        note = node_of_role(self._scene, NOTE) or self._scene.AddNewNodeByClass("vtkMRMLTextNode", "Registration")
        note.SetAttribute(ROLE_ATTRIBUTE, NOTE)
        self._proxies = {FRAME: live_scene.frame, TRANSFORM: live_scene.transform, NOTE: note}
        for role, proxy in self._proxies.items():
            sequence = self._scene.AddNewNodeByClass("vtkMRMLSequenceNode", f"{BROWSER_NAME} {proxy.GetName()}")
            sequence.SetIndexName("time")
            sequence.SetIndexUnit("s")
            sequence.SetIndexType(sequence.NumericIndex)
            sequence.SetAttribute(SEQUENCE_ATTRIBUTE, role)
            self.sequences[role] = sequence

    @property
    def full(self) -> bool:
        return self.mb >= self._limit_mb

    def add(self, result: LiveResult) -> bool:
        """Append a result that is shown in the live scene. False when it has no picture or time, or the limit is
        reached."""
        from ..registration.predictor import Prediction

        if result.image_rgb is None or not math.isfinite(result.frame.taken_s) or self.full:
            return False
        if self._begin_s is None:
            self._begin_s = result.frame.taken_s
        time_s = result.frame.taken_s - self._begin_s
        index = f"{time_s:.4f}"
        prediction = result.prediction or Prediction(None, False, 0.0, 0.0)
        frame = RecordedFrame(
            time_s,
            result.frame.name,
            result.camera,
            Prediction(
                prediction.camera_from_world,
                result.accepted,
                prediction.confidence,
                prediction.latency_ms,
                prediction.covariance,
            ),
            steadied=result.steadied,
        )
        self._proxies[NOTE].SetText(to_note(frame, result.case_key))
        for role, sequence in self.sequences.items():
            sequence.SetDataNodeAtValue(self._proxies[role], index)
        self.mb += result.image_rgb.nbytes / 2**20
        self.frames += 1
        return True

    def finish(self):
        """The browser, at its last frame, which is the one on the screen; None and no nodes when nothing was recorded.

        Only now: a browser that is there plays into the live nodes with every frame that is added.
        """
        if not self.frames:
            for node in (*self.sequences.values(), self._proxies[NOTE]):
                self._scene.RemoveNode(node)
            return None
        browser = self._scene.AddNewNodeByClass("vtkMRMLSequenceBrowserNode", BROWSER_NAME)
        browser.SetAttribute(BROWSER_ATTRIBUTE, "1")
        browser.SetPlaybackRateFps(20.0)
        was_modifying = browser.StartModify()
        for role, sequence in self.sequences.items():
            browser.AddSynchronizedSequenceNodeID(sequence.GetID())
            browser.AddProxyNode(self._proxies[role], sequence, False)
            browser.SetOverwriteProxyName(sequence, False)
            browser.SetSaveChanges(sequence, False)
        browser.SetSelectedItemNumber(self.frames - 1)
        browser.EndModify(was_modifying)
        return browser


def recordings(scene) -> list:
    """The browsers of recordings in the scene, also of one that was loaded, in the order they were made."""
    return [browser for browser in browsers(scene) if browser.GetAttribute(BROWSER_ATTRIBUTE)]


def pause_playback(scene, but=None) -> None:
    """Recordings, and sessions, show their frames in the same nodes: not two at once. but: the one that may go on."""
    for browser in recordings(scene):
        if browser is not but and browser.GetPlaybackActive():
            browser.SetPlaybackActive(False)


def recorded_frames(browser) -> Iterator[tuple[RecordedFrame, str]]:
    """Each recorded frame, without pixels, and the key of its case. Raises InputError for a browser that is no
    recording."""
    notes = _sequence(browser, NOTE)
    for item in range(notes.GetNumberOfDataNodes()):
        yield from_note(notes.GetNthDataNode(item).GetText())


def frame_at(browser) -> tuple[RecordedFrame, str]:
    """The recorded frame that the browser is at, without pixels, and the key of its case."""
    item = browser.GetSelectedItemNumber()
    note = _sequence(browser, NOTE).GetNthDataNode(item)
    if note is None:
        raise InputError(f"{browser.GetName()}: has no frame {item}; record again.")
    return from_note(note.GetText())


def put_back(browser, live_scene: LiveScene) -> None:
    """Put the recorded frame and transform that the browser is at into the live nodes.

    Slicer does so when the browser moves; a session that went on after the recording has left its own last frame there.
    """
    for role, node in ((FRAME, live_scene.frame), (TRANSFORM, live_scene.transform)):
        recorded = _sequence(browser, role).GetNthDataNode(browser.GetSelectedItemNumber())
        if node is not None and recorded is not None:
            node.CopyContent(recorded, True)  # deep: a session writes new pixels into the frame's own memory
            node.SetAttribute(ROLE_ATTRIBUTE, role)  # copied as well, and in a loaded recording there is none


def export(browser, folder: Path, case: Case) -> Path:
    """Write the frames, poses.json and a transform (.tfm, camera to Slicer's world) of each frame that had an overlay.

    case: that it was recorded with. Returns the path of poses.json. Where the camera changed, as with the size of the
    frames or of their borders, each camera's frames are in a folder of their own, and `folder` is returned. Raises
    InputError for a recording of another case, and when it cannot be written.
    """
    folder, noted = Path(folder), list(recorded_frames(browser))
    if any(key != case.vessels_sha256 for _frame, key in noted):
        raise InputError(
            f"{browser.GetName()}: was recorded with the vessels of another case; choose that case, then export."
        )
    by_camera: dict = {}
    for item, (frame, _key) in enumerate(noted):
        by_camera.setdefault(frame.camera, []).append((item, frame))
    parts = list(by_camera.values()) or [[]]
    if len(parts) == 1:
        return _export_part(browser, folder, case, parts[0])
    for number, part in enumerate(parts, 1):
        _export_part(browser, folder / f"camera_{number}", case, part)
    return folder


def _export_part(browser, folder: Path, case: Case, frames: list[tuple[int, RecordedFrame]]) -> Path:
    """frames: of one camera, each with its item of the recording."""
    pictures = _sequence(browser, FRAME)
    poses_path = export_recording(
        folder,
        (replace(frame, image_rgb=pixels_of(pictures.GetNthDataNode(item).GetImageData())) for item, frame in frames),
        case.vessels_sha256,
    )
    for number, (_item, frame) in enumerate(frames):
        if frame.prediction.accepted:  # a file of its own cannot say that it must not be believed
            matrix = camera_to_ras(frame.camera_from_world, case.space)
            write_transform(folder / "transforms" / f"{number:05d}.tfm", matrix)
    return poses_path


def write_transform(path: Path, matrix_to_ras: np.ndarray) -> None:
    """A 4x4 to RAS as a transform file that Slicer and ITK read; whole or not at all."""
    import slicer

    from .. import files

    node = slicer.vtkMRMLLinearTransformNode()
    scenes.set_pose(node, matrix_to_ras)
    storage = slicer.vtkMRMLTransformStorageNode()
    with files.replacing(Path(path)) as temporary:
        storage.SetFileName(str(temporary))
        if not storage.WriteData(node):
            raise InputError(f"{path}: the transform could not be written; free some space or choose another folder.")


def _sequence(browser, role: str):
    for node in nodes_of_class(browser.GetScene(), "vtkMRMLSequenceNode"):
        if node.GetAttribute(SEQUENCE_ATTRIBUTE) == role and browser.IsSynchronizedSequenceNodeID(node.GetID(), True):
            return node
    raise InputError(f"{browser.GetName()}: is no recording of this panel; choose one that was recorded here.")
