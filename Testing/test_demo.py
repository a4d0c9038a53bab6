import pytest
from cases import write_inputs

from ExpectedAppearancesLib import files
from ExpectedAppearancesLib.case.case import Case
from ExpectedAppearancesLib.cli import main
from ExpectedAppearancesLib.demo import phantom, pipeline
from ExpectedAppearancesLib.errors import ExpectedAppearancesError, InputError
from ExpectedAppearancesLib.masks.stage import render_case


def test_a_folder_of_something_else_is_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match="is no demo"):
        pipeline.run_demo(tmp_path, lambda *_: None)
    assert (tmp_path / "thesis.tex").read_text() == "years of work" and len(list(tmp_path.iterdir())) == 1


def test_a_demo_of_other_settings_is_left_alone(tmp_path):
    """What was made in it since, such as a study, took hours."""
    files.write_json(tmp_path / "demo.json", {"seed": 2, "minutes": 22.0, "textures": 10})
    files.write_json(tmp_path / "case" / "study" / "study.json", {})
    with pytest.raises(InputError, match=r"seed 2, minutes 22\.0, textures 10"):
        pipeline.run_demo(tmp_path, lambda *_: None)
    assert (tmp_path / "case" / "study" / "study.json").is_file()


def test_a_failing_stage_ends_the_demo_and_is_named(tmp_path):
    """The stages are real commands in processes of their own: one with bad input must not be passed over."""
    with pytest.raises(ExpectedAppearancesError, match=r"`render .*exit code 2"):
        pipeline._run(["render", tmp_path / "no case"])


def test_what_cannot_be_a_demo_is_bad_input(tmp_path, capsys):
    """Each ended as a failure of the program."""
    (tmp_path / "file").touch()
    (tmp_path / "damaged").mkdir()
    (tmp_path / "damaged" / "demo.json").touch()  # after a loss of power
    for arguments, words in (
        (["--out", str(tmp_path / "file")], "is a file"),
        (["--out", str(tmp_path / "damaged")], "cannot be read as JSON"),
        (["--out", str(tmp_path / "new"), "--seed", "-1"], "--seed at least 0"),
    ):
        assert main(["demo", *arguments]) == 2
        assert words in capsys.readouterr().err


def test_a_seed_below_0_is_bad_input(tmp_path):
    paths = write_inputs(tmp_path)
    case = Case.create(tmp_path / "case", paths["vessels.vtp"], paths["cortex.vtp"], paths["camera.json"])
    with pytest.raises(InputError, match="seed: -1"):
        render_case(case, lambda *_: None, poses=1, seed=-1)


def test_the_phantoms_network_is_the_one_that_its_text_describes():
    assert phantom.network_bytes() == phantom.NETWORK.read_bytes()
