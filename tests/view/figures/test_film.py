"""Films of plans: what every picture shows, how long they last, and files that are whole or not there."""

import dataclasses
import shutil
import subprocess
from contextlib import contextmanager

import casadi as ca
import matplotlib
import numpy as np
import pytest
from common import UNJUDGED
from lumens import straight
from PIL import Image

from ctr_nlp import Problem, curve_from_formula, growing, solve_per_frame, table_i_robot
from ctr_nlp.cli.commands import plan as plan_program
from ctr_nlp.exceptions import OptionError, OutputError
from ctr_nlp.paths.lumen import Lumen
from ctr_nlp.view.figures import film
from ctr_nlp.view.figures.film import WRITERS
from ctr_nlp.view.figures.parts.palette import TUBE_COLOURS

FRAMES = 4
RADIUS = 7.0
needs_ffmpeg = pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="ffmpeg is not installed")


def solved(frames, duration=10.0):
    path = curve_from_formula(lambda u: (100 - ca.sqrt(100**2 - u**2), 0, u), 0.0, 60.0)
    return solve_per_frame(
        Problem("arc", table_i_robot(), growing(path, frames), duration), model="dominant", direction="forward"
    )


@pytest.fixture(scope="module")
def plan():
    return solved(FRAMES)


@pytest.fixture(scope="module")
def longer():
    return solved(8, 3.0)


@pytest.fixture
def pictures(monkeypatch):
    """What a film's figure holds at every picture, and how fast it plays, in place of a file's contents."""
    seen = []

    class Recorder:
        isAvailable = staticmethod(lambda: True)

        def __init__(self, fps):
            self.fps = fps

        @contextmanager
        def saving(self, figure, path, dpi):
            self.figure = figure
            open(path, "w").close()
            yield

        def grab_frame(self):
            self.figure.draw_without_rendering()
            seen.append(Picture(self.figure, self.fps))

    monkeypatch.setitem(WRITERS, ".gif", Recorder)
    return seen


class Picture:
    """One picture: columns, from the left, each with its robot, target, errors and words."""

    def __init__(self, figure, fps):
        self.fps = fps
        spaces = [axes for axes in figure.axes if hasattr(axes, "get_zlim")]
        self.errors = [axes for axes in figure.axes if not hasattr(axes, "get_zlim")]
        self.labels = [{axes.get_xlabel(), axes.get_ylabel(), axes.get_zlabel()} for axes in spaces]
        self.key = [text.get_text() for text in figure.legends[0].get_texts()]
        self.words = [text.get_text() for text in figure.texts]
        self.cursors = [axes.lines[-1].get_xdata()[0] for axes in self.errors]
        self.tubes = [
            points(axes, lambda line: line.get_color() in TUBE_COLOURS and line.get_lw() > 1) for axes in spaces
        ]
        self.targets = [points(axes, lambda line: line.is_dashed()) for axes in spaces]
        self.walls = [points(axes, lambda line: line.get_color() == "0.72") for axes in spaces]
        self.scales = [np.ptp([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()], axis=1) for axes in spaces]


def points(axes, wanted):
    found = [np.array(line.get_data_3d(), dtype=float).T for line in axes.lines if wanted(line)]
    return np.concatenate([np.zeros((0, 3)), *found])


def unreached(plan, frame):
    """The plan as if one frame, from 1, had not been reached."""
    parts = {}
    for name in ("alpha", "beta", "theta", "shape", "tip_direction", "objective", "kkt"):
        parts[name] = np.array(getattr(plan, name), dtype=float)
        parts[name][frame - 1] = np.nan
    return dataclasses.replace(plan, success=np.arange(len(plan.time)) != frame - 1, **parts)


def test_every_frame_is_drawn_with_its_tubes_target_and_errors(plan, pictures, tmp_path):
    assert film([plan], tmp_path / "film.gif") == tmp_path / "film.gif"
    assert len(pictures) == FRAMES
    assert pictures[0].fps == pytest.approx(FRAMES / plan.time[-1])
    for j, picture in enumerate(pictures):
        np.testing.assert_allclose(picture.tubes[0][-1], plan.shape[j, -1])
        length = np.linalg.norm(np.diff(picture.tubes[0], axis=0), axis=1).sum()
        assert length == pytest.approx(plan.beta[j, -1], abs=0.02)
        np.testing.assert_allclose(picture.targets[0], plan.target[j])
        assert picture.cursors == [j + 1]
        assert f"frame {j + 1} of {FRAMES}, {plan.time[j]:.2f} s" in picture.words
        assert not len(picture.walls[0])


def test_titles_and_axes_say_what_is_shown(plan, pictures, tmp_path):
    film([plan], tmp_path / "film.gif")
    assert pictures[0].labels == [{"x (mm)", "y (mm)", "z (mm)"}]
    assert pictures[0].errors[0].get_xlabel() == "frame"
    assert pictures[0].errors[0].get_ylabel() == "distance (mm)"
    assert any(words.startswith("arc: joint") and "e3 = " in words for words in pictures[0].words)


def test_plans_of_any_length_play_in_step_and_at_one_scale(plan, longer, pictures, tmp_path):
    film([plan, longer], tmp_path / "film.gif")
    assert len(pictures) == 8
    assert pictures[0].fps == pytest.approx(8 / 10.0)
    assert [picture.cursors for picture in pictures] == [[-(-k // 2), k] for k in range(1, 9)]
    np.testing.assert_allclose(pictures[3].tubes[0][-1], plan.shape[1, -1])
    np.testing.assert_allclose(pictures[3].tubes[1][-1], longer.shape[3, -1])
    np.testing.assert_allclose(*pictures[0].scales)
    assert pictures[0].errors[0].get_ylim() == pictures[0].errors[1].get_ylim()


def test_a_plan_of_many_frames_does_not_make_a_film_of_many_pictures(plan, pictures, tmp_path):
    index = np.arange(90) % FRAMES
    names = ("alpha", "beta", "theta", "target", "shape", "target_direction", "tip_direction", "success")
    parts = {name: getattr(plan, name)[index] for name in (*names, "objective", "kkt", "solve_time")}
    margins = {name: np.full(90, np.nan) for name in ("stability", "stability_between")}
    many = dataclasses.replace(plan, time=np.arange(1, 91) / 45, **parts, **margins)
    film([many], tmp_path / "film.gif")
    assert len(pictures) == 50
    assert pictures[-1].cursors == [90]
    assert pictures[0].fps == pytest.approx(25.0)


def test_frames_never_reached_and_failed_ones_are_shown_as_such(plan, pictures, tmp_path):
    film([unreached(plan, 2)], tmp_path / "film.gif")
    assert [len(picture.tubes[0]) > 0 for picture in pictures] == [True, False, True, True]
    assert ["not reached" in "".join(picture.words) for picture in pictures] == [False, True, False, False]
    np.testing.assert_allclose(pictures[1].targets[0], plan.target[1])
    pictures.clear()
    film([plan, dataclasses.replace(plan, success=np.arange(FRAMES) != 2)], tmp_path / "film.gif")
    failed = [[words for words in picture.words if words.endswith(", failed")] for picture in pictures]
    assert failed == [[], [], ["frame 3 of 4, 7.50 s, failed"], []]
    assert "failed frame" in pictures[0].key


def test_the_wall_is_drawn_where_it_is(plan, pictures, tmp_path):
    lumen = Lumen.from_curve(straight(RADIUS)).table
    film([dataclasses.replace(plan, lumen=lumen)], tmp_path / "film.gif")
    wall = pictures[0].walls[0]
    wall = wall[np.isfinite(wall).all(axis=1)]
    np.testing.assert_allclose(np.linalg.norm(wall[:, :2], axis=1), RADIUS)
    assert (wall[:, 2].min(), wall[:, 2].max()) == (0.0, lumen[-1, 2])
    assert pictures[0].scales[0][2] > lumen[-1, 2]


def test_a_gif_lasts_as_long_as_its_plan(plan, tmp_path):
    told = []
    film([plan], tmp_path / "film.gif", lambda done, total, note: told.append((done, total)))
    assert told == [(k, FRAMES) for k in range(1, FRAMES + 1)]
    with Image.open(tmp_path / "film.gif") as image:
        assert image.n_frames == FRAMES
        total = 0.0
        for k in range(FRAMES):
            image.seek(k)
            total += image.info["duration"] / 1e3
            assert np.asarray(image.convert("RGB")).std() > 5
    assert total == pytest.approx(plan.time[-1], rel=0.01)
    assert list(tmp_path.iterdir()) == [tmp_path / "film.gif"]


@needs_ffmpeg
def test_an_mp4_has_a_picture_a_frame(plan, longer, tmp_path):
    path = film([plan, longer], tmp_path / "film.mp4")
    raw = ["ffmpeg", "-loglevel", "error", "-i", path, "-f", "rawvideo", "-pix_fmt", "gray", "-"]
    pixels = np.frombuffer(subprocess.run(raw, capture_output=True, check=True).stdout, dtype=np.uint8)
    frames = pixels.reshape(8, 720, 960)
    assert (abs(np.diff(frames.astype(int), axis=0)) > 50).any(axis=(1, 2)).all()
    assert list(tmp_path.iterdir()) == [path]


def test_other_suffixes_and_no_plans_are_refused(plan, tmp_path):
    with pytest.raises(OptionError, match=r"film\.avi.* suffix must be \.gif or \.mp4"):
        film([plan], tmp_path / "film.avi")
    with pytest.raises(OptionError, match="plans is empty"):
        film([], tmp_path / "film.gif")


def test_a_film_that_fails_leaves_what_was_there(plan, monkeypatch, tmp_path):
    class Failing(WRITERS[".gif"]):
        def finish(self):
            (tmp_path / "seen").write_text(str(sorted(path.name for path in tmp_path.iterdir())))
            raise OSError("the disk is full")

    monkeypatch.setitem(WRITERS, ".gif", Failing)
    (tmp_path / "film.gif").write_bytes(b"before")
    with pytest.raises(OutputError, match=r"film\.gif cannot be written: the disk is full"):
        film([plan], tmp_path / "film.gif")
    assert (tmp_path / "film.gif").read_bytes() == b"before"
    assert {path.name for path in tmp_path.iterdir()} == {"film.gif", "seen"}


@needs_ffmpeg
def test_a_film_that_ffmpeg_cannot_make_is_an_error_of_ours(plan, tmp_path):
    with (
        matplotlib.rc_context({"animation.bitrate": -1, "animation.ffmpeg_args": ["-c:v", "no_such_codec"]}),
        pytest.raises(OutputError, match=r"film\.mp4 cannot be written"),
    ):
        film([plan], tmp_path / "film.mp4")
    assert list(tmp_path.iterdir()) == []


# The programs


@pytest.fixture(params=["steer", "horizon"])
def program(request, monkeypatch):
    """Both programs, which must not get as far as building a solver where unsolved is asked for."""
    main, solver = {
        "steer": (plan_program.steer, "ctr_nlp.planning.per_frame.solve_per_frame"),
        "horizon": (plan_program.plan, "ctr_nlp.planning.horizon.horizon_planner"),
    }[request.param]

    def run(*arguments, unsolved=False):
        if unsolved:
            monkeypatch.setattr(solver, lambda *_, **__: pytest.fail("solving was begun"))
        return main([*UNJUDGED, "arc", "--model", "dominant", "--frames", "4", *map(str, arguments)])

    return run


def test_programs_write_films_into_their_folders_and_elsewhere(program, tmp_path, capsys):
    out = tmp_path / "out"
    (tmp_path / "beside.gif").write_bytes(b"before")
    for film_file in (out / "deep" / "in.gif", tmp_path / "beside.gif", out / ".." / "above.gif"):
        assert program("--out", out, "--film", film_file) == 0
        assert f"wrote {film_file}" in capsys.readouterr().out.replace("\n", "")
        with Image.open(film_file) as image:
            assert image.n_frames == 4
        assert (out / "plan.npz").is_file()


@pytest.mark.parametrize("kind", ["suffix", "folder", "link", "no ffmpeg"])
def test_programs_refuse_a_film_before_they_solve(program, kind, tmp_path, capsys):
    file = tmp_path / {"suffix": "film.webm", "no ffmpeg": "film.mp4"}.get(kind, "film.gif")
    if kind == "folder":
        file.mkdir()
    if kind == "link":
        file.symlink_to(tmp_path / "elsewhere.gif")
    with matplotlib.rc_context({"animation.ffmpeg_path": "no-such-program"}):
        assert program("--out", tmp_path / "out", "--film", file, unsolved=True) == 2
    said = capsys.readouterr().err
    assert file.name in said
    assert {"suffix": ".gif or .mp4", "no ffmpeg": "a .gif, which needs none"}.get(
        kind, "a folder or a link"
    ) in said
    assert not (tmp_path / "out").exists()
