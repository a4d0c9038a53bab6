"""A live session in a scene: what the panel's buttons do. Knows MRML and no Qt; the panel calls `tick` on its timer."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np

from ..case.case import Case
from ..errors import InputError
from ..geometry.camera import Camera
from ..geometry.pose import look_at
from ..live.alignment import PoseDifference, compare, nudge_between, nudged
from ..live.choice import Choice, SourceKind
from ..live.estimator import OpenedModel
from ..live.frames import LiveFrame
from ..live.loading import Loaded, Loading, load
from ..live.overlay import OverlayMaker
from ..live.recording import RecordedFrame, add_truth
from ..live.session import LiveResult, LiveSession, Update
from ..live.status import IDLE, Status
from ..live.steady import check_can_steady
from ..live.trust import Sight, Verdict
from ..poses.craniotomy import find_craniotomy
from . import live_record
from .live_align import Alignment, pose_of_landmarks
from .live_drawing import at_once
from .live_nodes import ROLE_ATTRIBUTE, hide_another_case, node_of_role, remove_live_nodes
from .live_scene import FRAME, PLANE_CHANGE, LiveScene, OverlayOptions
from .live_stream import NodeFrames, find_volume


class Views(Protocol):
    """Whoever shows a LiveScene: told after each change, in the same call, so that nothing is drawn in between."""

    def follow(self, live: LiveScene, changed: bool) -> None: ...

    def was_moved(self) -> bool: ...


class LiveController:
    """Owns the session, its nodes in `scene`, the recording and the alignment. `close` leaves nothing behind.

    drawing_held: gives the context in which no view is drawn, in Slicer widgets.drawing.DrawnInTurn.
    """

    def __init__(self, scene, views: Views | None = None, clock: Callable[[], float] = time.monotonic):
        self._scene, self._clock = scene, clock
        self.views = views
        self.drawing_held: Callable[[], contextlib.AbstractContextManager] = contextlib.nullcontext
        self.options = OverlayOptions()
        self.case: Case | None = None
        self.live: LiveScene | None = None
        self.recorder: live_record.Recorder | None = None
        self.alignment: Alignment | None = None
        self.truth: np.ndarray | None = None
        self.status = IDLE
        self.shown_in_ms = 0.0  # how long the GUI thread was held to put the last frame into the scene
        self._session: LiveSession | None = None
        self._loading: Loading | None = None
        self._begin: Callable[[Loaded], None] | None = None  # what is to be done once that is through
        self._stream: NodeFrames | None = None
        self._model: OpenedModel | None = None
        self._registers = True
        self._overlays: OverlayMaker | None = None
        self._replayed: tuple | None = None
        self._hidden: list = []  # models of another case
        self._seen_from: np.ndarray | None = None  # camera to world, as the views were laid out last

    @property
    def running(self) -> bool:
        """Whether a session goes on, or is being loaded."""
        return self._session is not None or self.loading

    @property
    def loading(self) -> bool:
        return self._loading is not None

    @property
    def frozen(self) -> bool:
        return self._session is not None and self._session.frozen

    @property
    def result(self) -> LiveResult | None:
        return self.status.result

    @property
    def camera(self) -> Camera | None:
        """Of the frame on the screen."""
        return self.live.camera if self.live else None

    # ------------------------------------------------------------------------------------------------------ session
    def open_case(self, folder: Path) -> Case:
        """Open a case and put its models into the scene, unless it is the one that is open. Raises InputError."""
        if not self._is_open(folder):
            case = Case.open(folder)
            case.vessels, case.cortex  # noqa: B018 - read now, so that what is wrong with them is said now
            self._put_up(case, OverlayMaker(case.vessels))
        self._hidden += hide_another_case(self._scene, self.case.folder)
        return self.case

    @at_once
    def restore(self, case_path: Path, camera: Camera) -> bool:
        """Show the frame that a saved scene brought, as `camera` took it, without overlay. False where there is none.

        Raises InputError for a case that cannot be opened.
        """
        if node_of_role(self._scene, FRAME) is None:
            return False
        self.open_case(case_path)
        if self.live.frame is None:  # it went with the nodes of another case
            return False
        self.live.take_replayed(camera)
        self._set_visible(False, changed=True)
        self._replayed = None  # a recording that is looked at is shown anew, with its overlay
        return True

    def start(self, choice: Choice, single: bool = False, model: OpenedModel | None = None) -> None:
        """Begin to register what was chosen; what must be read for that is read in a thread, while `tick` goes on.

        single: hold the first frame. What is wrong with case, model or source is in the status once `loading` is over.
        Raises InputError for a volume that is not in the scene.
        """
        self.stop()
        self._replayed = None
        node = self._node(choice) if choice.kind is SourceKind.NODE else None
        known = (self.case, self._overlays) if self._is_open(choice.case_path) else (None, None)
        self._loading = Loading(lambda: load(choice, *known, model))
        self._begin = lambda loaded: self._start_session(loaded, choice, single, node)
        self.tick()

    @at_once
    def stop(self) -> None:
        """End the session. The last frame stays, without its overlay."""
        self.finish_alignment(keep=False)
        self.stop_recording()
        if self._stream is not None:
            self._stream.close()
        if self._session is not None:
            self._session.stop()
        self._stream = self._session = self._loading = self._begin = None
        self.truth = None
        self.status = IDLE
        if self.live is not None:
            self.live.show_truth(None, None)
            self._set_visible(False)

    def leave(self) -> None:
        """Stop; what was hidden for the session is seen again in other modules."""
        self.stop()
        for node in self._hidden:
            if self._scene.IsNodePresent(node):
                node.SetDisplayVisibility(True)
        self._hidden = []

    def close(self) -> None:
        """Leave, and take everything out of the scene but recordings."""
        self.leave()
        if self.live is not None:
            self.live.close()
        else:
            remove_live_nodes(self._scene)
        self.forget_scene()

    def forget_scene(self) -> None:
        """The scene was closed, and the nodes are gone with it."""
        if self._stream is not None:
            self._stream.close()
        if self._session is not None:
            self._session.stop()
        self._stream = self._session = self.live = self.case = self.recorder = self.alignment = None
        self._model = self._overlays = self._replayed = self.truth = self._loading = self._begin = None
        self._hidden = []
        self.status = IDLE

    def freeze(self) -> None:
        if self._session is not None:
            self._session.freeze()

    @at_once
    def resume(self) -> None:
        self.finish_alignment(keep=False)
        self._forget_truth()
        if self._session is not None:
            self._session.resume()

    @at_once
    def next_frame(self) -> None:
        """Register one more frame and hold it; of a volume that does not change any more, what it holds."""
        self.finish_alignment(keep=False)
        self._forget_truth()
        if self._session is not None:
            self._session.next_frame()
        if self._stream is not None:
            self._stream.again_after(self._session.stale_s)

    def set_stale(self, stale_s: float) -> None:
        if self._session is not None:
            self._session.stale_s = stale_s

    def set_steady(self, steady: bool) -> None:
        """Filter the poses over time from the next frame on, or not. Raises InputError for a model that cannot."""
        if self._session is not None and steady != self._session.steady:
            if steady and self._registers:
                check_can_steady(self._model.estimator, self.case.model_folder)
            self._session.steady = steady

    @at_once
    def fit_views(self) -> None:
        """Show the whole frame again."""
        self._follow(True)

    @at_once
    def set_options(self, options: OverlayOptions) -> None:
        self.options = options
        if self.live is not None:
            self.live.set_options(options)
            self._follow(False)

    def tick(self, wait_s: float = 0.0) -> Status:
        """Show what is new and hide what may not be shown any more. Fast: everything slow is in the session's threads.

        wait_s: time to give to those threads; where the GUI holds Python's lock, they run in no other time.
        """
        if self._loading is not None:
            self._end_loading(wait_s)
            return self.status
        if self._session is None:
            return self.status
        if self._stream is not None:
            self._session.say_source(self._stream.look())
        update = self._session.tick(wait_s)
        damage = self.live.damage
        if damage:
            update = replace(update, verdict=Verdict(Sight.FAILED, update.verdict.age_s, damage))
        begin = time.perf_counter()
        self._show(update)
        if update.new is not None:
            self.shown_in_ms = (time.perf_counter() - begin) * 1000
        return self.status

    # -------------------------------------------------------------------------------------------------------- truth
    @at_once
    def begin_alignment(self) -> Alignment:
        """Let the vessels be moved over the frame that is held. Raises InputError when none is held."""
        result = self.result
        if not self.frozen or result is None or result.image_rgb is None:
            raise InputError("alignment: freeze a frame first, then align the vessels to it.")
        start = self.truth if self.truth is not None else result.camera_from_world
        if start is None and result.prediction is not None:
            start = result.prediction.camera_from_world
        if start is None:
            start = self._view_from_above(result.camera)
        overlay, plane_mm = self._overlays.make(self.live.camera, start), self.live.plane_mm
        if overlay is not None:
            self.live.put_plane_at(overlay.depth_mm)
        self.alignment = Alignment(self.live, self.case, start)
        self.show_truth(start)
        self._follow(abs(self.live.plane_mm / plane_mm - 1) > PLANE_CHANGE)
        return self.alignment

    @at_once
    def nudge(self, shift_mm: np.ndarray, turn_deg: np.ndarray, start: np.ndarray) -> None:
        """Move the vessels from `start` as the sliders say, in the camera's axes."""
        if self.alignment is not None:
            self.alignment.set_pose(nudged(start, self.case.vessels.centroid_mm, shift_mm, turn_deg))

    def nudges(self, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where the sliders would have to be for the vessels as they lie now: shift mm, turn deg."""
        return nudge_between(start, self.alignment.camera_from_world, self.case.vessels.centroid_mm)

    @at_once
    def align_to_landmarks(self, in_frame, on_mesh) -> float:
        """Move the vessels to where the pairs say; returns the root mean square error, px. Raises InputError."""
        if self.alignment is None:
            self.begin_alignment()
        found = pose_of_landmarks(self.live, self.case, in_frame, on_mesh)
        self.alignment.set_pose(found.camera_from_world)
        self.show_truth(found.camera_from_world)
        return found.rms_px

    @at_once
    def finish_alignment(self, keep: bool = True) -> None:
        if self.alignment is None:
            return
        pose = self.alignment.finish(keep)
        self.alignment = None
        self.show_truth(pose if keep else None)
        result = self.result
        if result is not None and result.accepted and self.live is not None:
            self.live.set_pose(result.camera_from_world)  # what was predicted is what the views follow
        self._follow(False)

    @at_once
    def show_truth(self, camera_from_world: np.ndarray | None) -> None:
        """Draw the true outline over the frame that is held."""
        if camera_from_world is not None and self.truth is not None and np.allclose(camera_from_world, self.truth):
            return
        self.truth = camera_from_world
        overlay = None if camera_from_world is None else self._overlays.make(self.live.camera, camera_from_world)
        self.live.show_truth(overlay, self.live.camera)
        self._follow(False)

    def difference(self) -> PoseDifference | None:
        """Of the predicted pose of the frame on the screen from its true one."""
        result = self.result
        if self.truth is None or result is None or result.camera_from_world is None:
            return None
        return compare(self.case.vessels.vertices_mm, self.truth, result.camera_from_world, result.camera)

    def save_truth(self, folder: Path) -> Path:
        """Add the frame with its true pose to folder/poses.json. Raises InputError."""
        if self.truth is None:
            raise InputError("true pose: there is none for this frame; align the vessels first.")
        return add_truth(folder, _recorded(self.result), self.truth, self.case.vessels_sha256)

    # ---------------------------------------------------------------------------------------------------- recording
    def start_recording(self, limit_mb: float = live_record.DEFAULT_LIMIT_MB) -> None:
        """Record from the next frame on. Raises InputError when no frame was shown yet."""
        if self.live is None or self.live.frame is None or self._session is None:
            raise InputError("recording: start the session first.")
        self.recorder = live_record.Recorder(self.live, limit_mb)

    def stop_recording(self):
        """The browser of what was recorded, or None."""
        recorder, self.recorder = self.recorder, None
        return recorder.finish() if recorder is not None else None

    def look_at(self, browser, case_path: str) -> Status:
        """`replay`, with the vessels of that case. Without one ('') and where it raises InputError no overlay is left:
        Slicer goes on to play frames, and that before was not theirs."""
        try:
            if case_path:
                self.open_case(case_path)
                return self.replay(browser)
        except InputError:
            self._look_away()
            raise
        self._look_away()
        return self.status

    def _look_away(self) -> None:
        self._replayed = None
        if self.result is not None:
            self.stop()

    @at_once
    def replay(self, browser) -> Status:
        """Draw the overlay of the recorded frame that `browser` is at; call it whenever it may have moved."""
        key = (browser.GetID(), browser.GetSelectedItemNumber(), id(self.live))
        if self.running or self.live is None:
            return self.status
        if self._replayed == key and self.live.intact:
            self._follow_models()
            return self.status
        self._replayed = key
        live_record.pause_playback(self._scene, but=browser)
        frame, recorded_key = live_record.frame_at(browser)
        verdict = Verdict(Sight.FROZEN if frame.prediction.accepted else Sight.REFUSED)
        if recorded_key != self.case.vessels_sha256:
            verdict = Verdict(Sight.OTHER_CASE)
        live_record.put_back(browser, self.live)
        changed = self.live.take_replayed(frame.camera)
        if verdict.shows_overlay:
            pose = frame.camera_from_world
            self.live.set_pose(pose)
            overlay = self._overlays.make(frame.camera, pose)
            if overlay is None:
                verdict = Verdict(Sight.REFUSED)
            else:
                self.live.draw(overlay, frame.camera)
        result = LiveResult(
            _frame_of(frame), recorded_key, None, frame.camera, frame.prediction, steadied=frame.steadied
        )
        self._set_visible(verdict.shows_overlay, changed)
        self.status = Status(verdict, result)
        return self.status

    # ----------------------------------------------------------------------------------------------------- internal
    def _is_open(self, folder: Path) -> bool:
        there = self.case is not None and self.live is not None and not self.live.damage
        return there and self.case.folder == Path(folder).absolute()

    def _put_up(self, case: Case, overlays: OverlayMaker) -> None:
        """The nodes of a case, instead of those of the case before."""
        if self.live is not None:
            self.close()
        self.case, self._overlays = case, overlays
        self.live = LiveScene(self._scene, case)
        self.live.set_options(self.options)

    @at_once
    def _end_loading(self, wait_s: float) -> None:
        loading, begin = self._loading, self._begin
        if not loading.done(wait_s):
            self.status = Status(Verdict(Sight.LOADING))
            return
        self._loading = self._begin = None
        self.status = Status(IDLE.verdict, problem=loading.problem)
        if not loading.problem:
            begin(loading.take())

    def _start_session(self, loaded: Loaded, choice: Choice, single: bool, node) -> None:
        if self.case is not loaded.case:
            self._put_up(loaded.case, loaded.overlays)
        self._hidden += hide_another_case(self._scene, self.case.folder)
        self._registers = loaded.model is not None
        if loaded.model is not None:
            self._model = loaded.model
        estimator = loaded.model.estimator if loaded.model else None
        source = loaded.source
        self._session = LiveSession(
            self.case, estimator, source.camera, choice.frame_settings, choice.stale_s, self._clock, self._overlays
        )
        self._session.steady = choice.steady
        self._session.start(source.source, single or source.still)
        if node is not None:
            self._stream = NodeFrames(self._scene, node, self._session.push, self._clock)
        self.tick()

    @at_once
    def _show(self, update: Update) -> None:
        changed = False
        if update.new is not None:
            self._forget_truth()
            changed = self.live.show(update.new)
        elif update.shown is not None and not self.live.intact:
            live_record.pause_playback(self._scene)
            self.live.show_again(update.shown)
            self._follow(False)
        visible = update.verdict.shows_overlay
        self.live.set_overlay_visible(visible)
        if update.new is not None or visible != self._was_visible():
            self._follow(changed)
        else:
            self._follow_models()
        if update.new is not None and self.recorder is not None:
            self.recorder.add(update.new)
        if self.alignment is not None:
            self.show_truth(self.alignment.camera_from_world)
        self.status = self._status(update)

    def _node(self, choice: Choice):
        node = find_volume(self._scene, choice.node_name)
        if node is None:
            raise InputError(f"{choice.node_name}: there is no such volume in the scene; choose it again.")
        if node is node_of_role(self._scene, FRAME) or node.GetAttribute(ROLE_ATTRIBUTE):
            raise InputError(
                f"{node.GetName()}: is the picture that this panel shows; choose the volume that frames arrive in."
            )
        return node

    def _status(self, update: Update) -> Status:
        device = self._model.device if self._model and self._registers else ""
        return Status(update.verdict, update.shown, update.dropped, device, update.new is not None)

    def _was_visible(self) -> bool:
        return self.status.verdict.shows_overlay

    def _set_visible(self, visible: bool, changed: bool = False) -> None:
        self.live.set_overlay_visible(visible)
        self._follow(changed)

    def _follow(self, changed: bool) -> None:
        # A frame that a recording left has no camera before its own or another frame is shown.
        if self.views is not None and self.live is not None and self.live.frame is not None and self.live.camera:
            self._seen_from = self.live.camera_to_world
            self.views.follow(self.live, changed)

    def _follow_models(self) -> None:
        """While no new frame comes the user may move the models, camera and frame with them, or the view."""
        self.live.follow_models()
        views = self.views
        if views and (views.was_moved() or not np.array_equal(self.live.camera_to_world, self._seen_from)):
            self._follow(False)

    def _forget_truth(self) -> None:
        self.truth = None
        if self.live is not None:
            self.live.show_truth(None, None)

    def _view_from_above(self, camera: Camera) -> np.ndarray:
        """A pose to begin with where none is known: straight onto the vessels, from where they fill the view."""
        vessels = self.case.vessels
        craniotomy = find_craniotomy(vessels, self.case.cortex, self.case.space)
        distance_mm = 2 * vessels.radius_mm / camera.field_of_view_mm(1.0)
        centre = craniotomy.centre_world_mm + distance_mm * craniotomy.outward_axis
        return look_at(centre, craniotomy.centre_world_mm, craniotomy.up)


def _recorded(result: LiveResult) -> RecordedFrame:
    return RecordedFrame(0.0, result.frame.name, result.camera, result.prediction, result.image_rgb, result.steadied)


def _frame_of(frame: RecordedFrame) -> LiveFrame:
    return LiveFrame(np.empty((0, 0, 3), np.uint8), frame.time_s, 0, frame.name)
