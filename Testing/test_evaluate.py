from __future__ import annotations

import json
import zlib
from types import SimpleNamespace

import numpy as np
import pytest

from ExpectedAppearancesLib import files
from ExpectedAppearancesLib.case.case import Case
from ExpectedAppearancesLib.case.meshes import Mesh, write_vtp
from ExpectedAppearancesLib.cli import main
from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.evaluation import curves, overlays
from ExpectedAppearancesLib.evaluation.curves import curve_points
from ExpectedAppearancesLib.evaluation.evaluate import evaluate
from ExpectedAppearancesLib.evaluation.metrics import frame_errors, metrics
from ExpectedAppearancesLib.evaluation.report import headline, text_table
from ExpectedAppearancesLib.geometry.camera import Camera
from ExpectedAppearancesLib.geometry.pose import look_at, pose_from_rotation
from ExpectedAppearancesLib.poses.craniotomy import find_craniotomy
from ExpectedAppearancesLib.registration.poses_file import read_poses, write_poses
from ExpectedAppearancesLib.registration.predictor import fitted_camera

CAMERA = Camera(96, 96, 180.0, 180.0, 47.5, 47.5, (0.0,) * 5)
STYLES = ("day", "night")
FRAMES = 6


def ribbon_and_plane():
    """A 4 x 20 mm vessel ribbon at z = 1 above a 40 x 40 mm cortex at z = 0."""
    square = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], float)
    triangles = np.array([(0, 1, 2), (0, 2, 3)])
    return Mesh(square * (2, 10, 0) + (0, 0, 1), triangles), Mesh(square * (20, 20, 0), triangles)


@pytest.fixture
def case(tmp_path):
    vessels, cortex = ribbon_and_plane()
    write_vtp(tmp_path / "v.vtp", vessels)
    write_vtp(tmp_path / "c.vtp", cortex)
    files.write_json(tmp_path / "camera.json", CAMERA.to_dict())
    return Case.create(tmp_path / "case", tmp_path / "v.vtp", tmp_path / "c.vtp", tmp_path / "camera.json")


@pytest.fixture
def known(tmp_path):
    """poses.json with six frames of two styles; the first pixel of a frame is its number."""
    frames = []
    for i in range(FRAMES):
        image = np.full((96, 96, 3), 90, np.uint8)
        image[0, 0] = i
        path = tmp_path / "data" / STYLES[i % 2] / f"{i}.png"
        files.write_png(path, image)
        pose = look_at(np.array([3.0 * i - 8, 5.0, 80.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
        frames.append({"image": path, "camera_from_world": pose, "style": STYLES[i % 2]})
    write_poses(tmp_path / "data" / "poses.json", CAMERA, frames)
    return tmp_path / "data" / "poses.json"


class ShiftedPredictor:
    """Answers the true pose moved by 1 mm times the frame's number; no pose for the last, frame 4 refused."""

    def __init__(self, known_path):
        self.poses = [frame.camera_from_world for frame in read_poses(known_path)[1]]

    def predict(self, image_rgb, camera):
        assert camera == CAMERA
        i = int(image_rgb[0, 0, 0])
        pose = None if i == FRAMES - 1 else pose_from_rotation(np.eye(3), (float(i), 0, 0)) @ self.poses[i]
        return SimpleNamespace(camera_from_world=pose, accepted=i < 4, confidence=0.5, latency_ms=7.0, covariance=None)


def test_evaluate_writes_everything_and_the_figures_are_right(case, known, tmp_path):
    steps = []
    out = tmp_path / "out"
    evaluate(case, known, out, predictor=ShiftedPredictor(known), progress=lambda f, m: steps.append(f))
    result = json.loads((out / "metrics.json").read_text())
    assert (result["frames"], result["refused"], result["without_pose"]) == (6, 2, 1)
    assert result["add_mm"]["mean"] == pytest.approx((0 + 1 + 2 + 3 + 4) / 5)
    assert result["add_mm"]["lateral_mean"] == pytest.approx(2) and result["add_mm"]["depth_mean"] == pytest.approx(0)
    assert result["accuracy"]["3mm-3deg"] == pytest.approx(3 / 6, abs=1e-9)
    assert result["accepted_only"]["add_mm"]["mean"] == pytest.approx(1.5)
    assert result["styles"]["day"]["add_mm"]["mean"] == pytest.approx((0 + 2 + 4) / 3)
    assert result["styles"]["night"]["add_mm"]["mean"] == pytest.approx((1 + 3) / 2)
    assert result["latency_ms"]["median"] == 7 and 0.05 < result["mean_pose_add_mm"] < 1
    assert result["curves"]["add"][2] == pytest.approx(2 / 6)

    camera, predicted = read_poses(out / "predicted.json")
    assert camera == CAMERA and [frame.style for frame in predicted] == [STYLES[i % 2] for i in range(6)]
    assert predicted[3].image == read_poses(known)[1][3].image and predicted[3].extra["errors"]["add_mm"] == 3
    assert [frame.accepted for frame in predicted] == [True] * 4 + [False] * 2
    # All confidences are 0.5; 0, 1 and 2 mm are below 3 mm.
    assert result["add_below_3mm"] == pytest.approx(3 / 6) and result["accepted_only"]["add_below_3mm"] == 0.75
    assert result["reliability"]["bins"] == [
        {"from": 0.5, "to": 0.6, "frames": 6, "confidence": 0.5, "add_below_3mm": 0.5}
    ]
    for name in ("curves.png", "styles.png", "overlays.png", "reliability.png"):
        assert files.read_image_rgb(out / name).std() > 5
    assert len(list((out / "overlays").glob("*.png"))) == 6
    assert steps == sorted(steps) and steps[-1] == 1.0


def test_overlay_shows_true_outline_green_and_predicted_blue_where_they_project(case, known, tmp_path):
    evaluate(case, known, tmp_path / "out", predictor=ShiftedPredictor(known))
    (path,) = (tmp_path / "out" / "overlays").glob("*_3.png")
    tile = files.read_image_rgb(path).astype(int)
    scale = tile.shape[1] // 96
    true = read_poses(known)[1][3].camera_from_world
    vertices = case.vessels.vertices_mm
    big = CAMERA.resized(96 * scale, 96 * scale)
    for shift_mm, colour in ((0, overlays.TRUE_RGB), (3, overlays.PREDICTED_RGB)):
        pose = pose_from_rotation(np.eye(3), (shift_mm, 0, 0)) @ true
        corners = big.project(vertices @ pose[:3, :3].T + pose[:3, 3])
        rows, columns = np.nonzero((np.abs(tile - colour).sum(2) < 30)[: big.height])
        np.testing.assert_allclose((columns.min(), rows.min()), corners.min(0), atol=4)
        np.testing.assert_allclose((columns.max(), rows.max()), corners.max(0), atol=4)


def test_overlay_without_a_cortex_hides_nothing_behind_a_disc_on_the_wrong_side(known, tmp_path):
    """Vessels that lie in a plane do not tell which side is out; `render --normal` did."""
    vessels, _ = ribbon_and_plane()
    write_vtp(tmp_path / "v.vtp", vessels)
    for side in (1.0, -1.0):
        case = Case.create(tmp_path / f"case{side}", tmp_path / "v.vtp", None, CAMERA)
        craniotomy = find_craniotomy(case.vessels, normal=[0, 0, side])
        case.record("render", craniotomy={key: np.asarray(value).tolist() for key, value in vars(craniotomy).items()})
        frames = [frame.to_dict() for frame in read_poses(known)[1]]
        if side < 0:  # the same views from below
            turn = np.diag([1.0, -1.0, -1.0, 1.0])
            frames = [f | {"camera_from_world": f["camera_from_world"] @ turn} for f in frames]
        write_poses(tmp_path / "poses.json", CAMERA, frames)
        evaluate(case, tmp_path / "poses.json", tmp_path / "out", predicted_path=tmp_path / "poses.json")
        for path in (tmp_path / "out" / "overlays").glob("*.png"):
            assert (np.abs(files.read_image_rgb(path).astype(int) - overlays.PREDICTED_RGB).sum(2) < 30).any(), path


def test_report_is_one_file_with_escaped_names_and_embedded_figures(case, known, tmp_path):
    values = json.loads(known.read_text())
    for frame in values["frames"][::2]:
        frame["style"] = "<b>day"
    known.write_text(json.dumps(values))
    result = evaluate(case, known, tmp_path / "out", predictor=ShiftedPredictor(known)).metrics
    html = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert html.count("data:image/") == 4 and 'src="http' not in html
    assert "&lt;b&gt;day" in html and "<b>day" not in html
    assert "ADD 2.00 mm" in headline(result) and headline(result).split(":")[0] in html
    assert "2.00" in text_table(result).splitlines()[1]


def test_command_compares_a_prediction_file_and_only_the_wanted_styles(case, known, tmp_path, capsys):
    camera, frames = read_poses(known)
    predicted = [frame.to_dict() | {"accepted": True} for frame in reversed(frames)]
    for frame in predicted:
        frame["camera_from_world"] = pose_from_rotation(np.eye(3), (0, 0, 2.5)) @ frame["camera_from_world"]
    write_poses(tmp_path / "predicted.json", camera, predicted)
    argv = ["evaluate", case.folder, "--poses", known, "--predicted", tmp_path / "predicted.json"]
    assert main([*map(str, argv), "--styles", "night", "--out", str(tmp_path / "out")]) == 0
    result = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert result["frames"] == 3 and set(result["styles"]) == {"night"}
    assert result["add_mm"]["mean"] == pytest.approx(2.5) and result["add_mm"]["depth_mean"] == pytest.approx(2.5)
    assert "2.50" in capsys.readouterr().out


def test_poses_of_another_program_are_compared_whatever_they_say_of_confidence_and_latency(case, known, tmp_path):
    camera, frames = read_poses(known)
    others = ({"confidence": 95.0}, {"confidence": "high"}, {"latency_ms": "12 ms"}, {"latency_ms": None}, {}, {})
    write_poses(tmp_path / "p.json", camera, [f.to_dict() | other for f, other in zip(frames, others)])
    result = evaluate(case, known, tmp_path / "out", predicted_path=tmp_path / "p.json").metrics
    assert result["add_mm"]["mean"] == 0 and not {"latency_ms", "reliability"} & result.keys()


def test_a_style_is_no_path(case, known, tmp_path):
    """An overlay was written outside of --out, and a long name ended the evaluation when all was registered."""
    camera, frames = read_poses(known)
    styles = ("../../../up", "left/right", "ä" * 300, "a:b", "a", "")
    write_poses(known, camera, [f.to_dict() | {"style": style} for f, style in zip(frames, styles)])
    before = set(tmp_path.rglob("*.png"))
    evaluate(case, known, tmp_path / "out", predicted_path=known)
    made = sorted((set(tmp_path.rglob("*.png")) - before) - set((tmp_path / "out").glob("*.png")))
    assert len(made) == FRAMES and {path.parent for path in made} == {tmp_path / "out" / "overlays"}
    assert any(path.name.endswith("_left_right_1.png") for path in made)


def test_styles_with_dollar_signs_are_drawn_as_they_are_called(case, known, tmp_path):
    """They were taken for formulas, and a bad one ended the evaluation when all was registered."""
    camera, frames = read_poses(known)
    write_poses(known, camera, [f.to_dict() | {"style": style} for f, style in zip(frames, ["$5 $x_", r"$\no$"] * 3)])
    evaluate(case, known, tmp_path / "out", predicted_path=known)
    assert (tmp_path / "out" / "styles.png").is_file()


def test_only_overlays_of_an_earlier_run_are_removed(case, known, tmp_path):
    folder = tmp_path / "out" / "overlays"
    for name in ("00_day_0.png", "11_night_9.png", "brain.png"):
        files.write_png(folder / name, np.zeros((4, 4, 3), np.uint8))
    evaluate(case, known, tmp_path / "out", predicted_path=known)
    assert (folder / "brain.png").is_file() and not (folder / "11_night_9.png").exists()


def test_all_problems_at_once_and_nothing_written(case, known, tmp_path):
    images = [frame.image for frame in read_poses(known)[1]]
    images[0].unlink()
    images[4].unlink()
    (tmp_path / "a file").write_text("")
    with pytest.raises(InputError) as caught:
        evaluate(case, known, tmp_path / "a file" / "out", predicted_path=tmp_path / "none.json")
    text = "\n".join(caught.value.problems)
    assert len(caught.value.problems) == 4
    assert all(str(name) in text for name in (images[0], images[4], "a file", "none.json"))

    with pytest.raises(InputError, match=r"dusk.*day, night"):
        evaluate(case, known, tmp_path / "out", styles=["dusk"], predictor=ShiftedPredictor(known))
    assert not (tmp_path / "out").exists()


def test_prediction_that_lacks_frames_and_truth_without_pose_are_named(case, known, tmp_path):
    camera, frames = read_poses(known)
    write_poses(tmp_path / "p.json", camera, [frame.to_dict() for frame in frames[:4]])
    with pytest.raises(InputError) as caught:
        evaluate(case, known, tmp_path / "out", predicted_path=tmp_path / "p.json")
    assert [str(frames[i].image) in caught.value.problems[i - 4] for i in (4, 5)] == [True, True]
    write_poses(known, camera, [frame.to_dict() | {"camera_from_world": None} for frame in frames])
    with pytest.raises(InputError, match=r"5\.png has no camera_from_world"):
        evaluate(case, known, tmp_path / "out", predictor=None, predicted_path=tmp_path / "p.json")


def test_poses_of_another_case_are_compared_with_nothing(case, known, tmp_path):
    camera, frames = read_poses(known)
    entries = [frame.to_dict() for frame in frames]
    write_poses(tmp_path / "p.json", camera, entries, case.vessels_sha256)
    evaluate(case, known, tmp_path / "out", predicted_path=tmp_path / "p.json")
    for path in (known, tmp_path / "p.json"):
        write_poses(path, camera, entries, "0" * 64)
    with pytest.raises(InputError) as caught:
        evaluate(case, known, tmp_path / "out", predicted_path=tmp_path / "p.json")
    assert len(caught.value.problems) == 2 and all("of another case" in text for text in caught.value.problems)


def test_poses_that_were_registered_are_not_taken_for_known(case, known, tmp_path):
    """What `register` wrote, compared with the model that wrote it: 0.00 mm, 100 % within 3 mm and 3 degrees."""
    evaluate(case, known, tmp_path / "out", predictor=ShiftedPredictor(known))
    predicted = tmp_path / "out" / "predicted.json"
    with pytest.raises(InputError, match="not known to be right"):
        evaluate(case, predicted, tmp_path / "again", predicted_path=predicted)
    assert not (tmp_path / "again").exists()


def test_damaged_images_are_all_named(case, known, tmp_path):
    images = [frame.image for frame in read_poses(known)[1]]
    for i in (1, 2):
        images[i].write_bytes(images[i].read_bytes()[:20])
    data = bytearray(images[3].read_bytes())
    data[16:24] = b"\x00\x0d\xbb\xa0" * 2  # 900,000 x 900,000 px, which OpenCV does not even try
    data[29:33] = zlib.crc32(data[12:29]).to_bytes(4, "big")
    images[3].write_bytes(data)
    with pytest.raises(InputError) as caught:
        evaluate(case, known, tmp_path / "out", predictor=ShiftedPredictor(known))
    assert [str(images[i]) in caught.value.problems[i - 1] for i in (1, 2, 3)] == [True] * 3
    with pytest.raises(InputError, match=r"3\.png: label map cannot be read"):
        files.read_label_map(images[3])
    assert not (tmp_path / "out").exists()


def test_a_frame_that_does_not_fit_the_camera_is_named(case, known, tmp_path):
    class OfOneSize(ShiftedPredictor):
        def predict(self, image_rgb, camera):
            fitted_camera(camera, *image_rgb.shape[1::-1])
            return super().predict(image_rgb, camera)

    files.write_png(tmp_path / "data" / "night" / "1.png", np.full((96, 128, 3), 90, np.uint8))
    with pytest.raises(InputError, match=r"1\.png: the frame is 128 x 96 px") as error:
        evaluate(case, known, tmp_path / "out", predictor=OfOneSize(known))
    assert len(error.value.problems) == 1


def test_the_bars_of_a_style_without_any_pose_do_not_say_0_mm(tmp_path, monkeypatch):
    figures = []
    monkeypatch.setattr(curves, "write_figure", lambda _path, figure: figures.append(figure))
    errors = frame_errors(np.eye(3), [np.eye(4)] * 4, [np.eye(4), pose_from_rotation(np.eye(3), (8, 0, 0)), None, None])
    curves.write_style_bars(tmp_path / "styles.png", metrics(errors, ["day", "day", "night", "night"]))
    shown = [[text.get_text() for text in axes.texts] for axes in figures[0].axes]
    assert shown == [["4.00", "no pose"] * 2, ["50", "0"] * 2]


def test_curve_points_rise_to_the_share_that_has_a_pose():
    truth = [np.eye(4)] * 4
    shifts = (0.0, 4.5, 19.5)
    predicted = [pose_from_rotation(np.eye(3), (shift, 0, 0)) for shift in shifts]
    points = curve_points(frame_errors(np.eye(3), truth, [*predicted, None]))
    assert points["limits"] == list(range(21))
    assert points["add"] == [sum(shift < n for shift in shifts) / 4 for n in range(21)]
    assert points["n mm-n deg"] == points["add"]


def test_chosen_frames_hold_best_and_worst_and_spread_over_styles():
    rng = np.random.default_rng(0)
    error = rng.permutation(200).astype(float)
    styles = [f"s{i}" for i in rng.integers(0, 4, 200)]
    chosen = overlays.choose_frames(error, styles, 12)
    shown = error[chosen]
    assert len(shown) == 12 and shown[0] == 0 and shown[-1] == 199 and (np.diff(shown) > 0).all()
    np.testing.assert_allclose(shown, np.linspace(0, 199, 12), atol=5)
    assert min(sum(styles[i] == s for i in chosen) for s in set(styles)) >= 2
    error[error >= 150] = np.nan
    shown = error[overlays.choose_frames(error, styles, 12)]
    assert shown[10] == 149 and np.isnan(shown[11]) and not np.isnan(shown[:11]).any()


def test_few_frames_are_all_chosen():
    assert overlays.choose_frames(np.array([3.0, 1.0, 2.0]), ["a"] * 3, 12) == [1, 2, 0]
    assert overlays.choose_frames(np.array([3.0, np.nan, 2.0]), ["a"] * 3, 12) == [2, 0, 1]
    assert len(overlays.choose_frames(np.full(5, np.nan), ["a"] * 5, 12)) == 1


def test_sheet_and_overlay_refuse_what_does_not_fit():
    tiles = [np.full((20, 30, 3), value, np.uint8) for value in (10, 20, 30)]
    grid = overlays.sheet([*tiles, np.full((40, 60, 3), 40, np.uint8)], columns=2, gap_px=6)
    assert grid.shape == (46, 66, 3) and grid[45, 65].tolist() == [40] * 3 and grid[0, 0].tolist() == [10] * 3
    with pytest.raises(ValueError, match="does not fit"):
        overlays.draw_overlay(tiles[0], np.zeros((5, 5), np.uint8), None)
