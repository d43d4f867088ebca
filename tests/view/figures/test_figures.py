"""Pictures of plans: drawn whatever the number of tubes or frames, with units, and true to the plan."""

import dataclasses

import casadi as ca
import matplotlib
import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.colors import same_color
from matplotlib.image import imread

from ctr_nlp import Plan, Problem, Robot, Tube, curve_from_formula, growing, solve_per_frame, table_i_robot
from ctr_nlp import shapes as robot_shapes
from ctr_nlp.exceptions import OptionError, OutputError
from ctr_nlp.studies.pareto_front import ParetoPoint
from ctr_nlp.studies.pareto_picture import draw_pareto_front, save_pareto_front
from ctr_nlp.view.figures import by_frame, configuration, errors, save_all, shapes
from ctr_nlp.view.figures.motion import error_from_truth, without_whole_turns
from ctr_nlp.view.figures.parts.palette import TUBE_COLOURS

FRAMES = 6


def four_tubes():
    tubes = [
        Tube(100.0 * (i + 1), 40.0 * (i + 1), 1 / 80, outer_diameter=6.0 * 0.65**i, inner_diameter=4.8 * 0.65**i)
        for i in range(4)
    ]
    return Robot(tuple(tubes))


def arc(u):
    return 100 - ca.sqrt(100**2 - u**2), 0, u


def helix(u):
    return 20 - 20 * ca.cos(u / 40), 20 * ca.sin(u / 40), u


def solved(robot, frames=FRAMES, path=arc, length=40.0, name="arc"):
    target = growing(curve_from_formula(path, 0.0, length), frames)
    return solve_per_frame(Problem(name, robot, target), model="dominant", direction="forward")


@pytest.fixture(scope="module")
def plan():
    return solved(table_i_robot())


@pytest.fixture(scope="module")
def spatial():
    return solved(table_i_robot(), frames=1, path=helix)


def unreached(plan, missing):
    """The plan as if the work had ended before the frames in missing."""

    def hollow(array):
        result = np.array(array, dtype=float)
        result[missing] = np.nan
        return result

    names = ("alpha", "beta", "theta", "shape", "tip_direction", "solve_time", "objective", "kkt")
    success = plan.success.copy()
    success[missing] = False
    return dataclasses.replace(plan, success=success, **{name: hollow(getattr(plan, name)) for name in names})


def with_frames(plan, count):
    """A plan of count frames that repeats those of a shorter one."""
    index = np.arange(count) % len(plan.time)
    arrays = {
        f.name: getattr(plan, f.name)
        for f in dataclasses.fields(plan)
        if f.name not in ("meta", "to_robot", "walls")
    }
    repeated = {name: array[index] for name, array in arrays.items() if array is not None}
    return dataclasses.replace(plan, **repeated | {"time": np.arange(1, count + 1) * 0.1})


def title(figure):
    return figure.texts[0].get_text()


def labels(figure):
    return [text for axes in figure.axes for text in (axes.get_xlabel(), axes.get_ylabel()) if text]


def legends(figure):
    found = [*figure.legends, *(axes.get_legend() for axes in figure.axes if axes.get_legend())]
    return [text.get_text() for legend in found for text in legend.get_texts()]


def tube_lengths(axes):
    """Length on paper, in mm, of each tube's line in a panel of shapes."""
    lines = {line.get_color(): line.get_xydata() for line in axes.lines if line.get_color() in TUBE_COLOURS}
    return [
        np.linalg.norm(np.diff(lines[c], axis=0), axis=1).sum() if c in lines else 0.0 for c in TUBE_COLOURS[:3]
    ]


@pytest.mark.parametrize("tubes", [1, 2, 3, 4])
def test_all_pictures_are_written_for_any_number_of_tubes(tmp_path, tubes):
    robot = Robot(four_tubes().tubes[:tubes])
    told = []
    paths = save_all(solved(robot, length=30.0), tmp_path, progress=lambda *step: told.append(step))
    assert told == [(number, 4, path.stem) for number, path in enumerate(paths)]
    assert [path.name for path in paths] == ["shapes.png", "errors.png", "by_frame.png", "configuration.png"]
    for path in paths:
        pixels = imread(path)
        assert min(pixels.shape[:2]) > 400
        assert pixels[..., :3].std() > 0.02


def test_a_folder_that_does_not_exist_is_refused(plan, tmp_path):
    with pytest.raises(OutputError, match="nowhere"):
        save_all(plan, tmp_path / "nowhere")


def test_one_frame_is_enough(spatial, tmp_path):
    assert len(save_all(spatial, tmp_path)) == 4


@pytest.mark.parametrize("missing", [slice(3, None), slice(0, 5), slice(None)], ids=["end", "start", "all"])
def test_frames_never_reached_are_drawn_as_such(plan, missing, tmp_path):
    partial = unreached(dataclasses.replace(plan, truth=plan.q), missing)
    save_all(partial, tmp_path)
    titles = [axes.get_title() for axes in shapes(partial).axes]
    assert ["not reached" in title for title in titles] == [not ok for ok in partial.success]
    assert "not reached" in legends(by_frame(partial))
    assert "failed frame" not in legends(by_frame(partial))


def test_failed_frames_are_marked_everywhere(plan):
    failed = dataclasses.replace(plan, success=np.arange(FRAMES) != 2)
    assert [axes.get_title().count("failed") for axes in shapes(failed).axes] == [0, 0, 1, 0, 0, 0]
    axes = by_frame(failed).axes[0]
    (band,) = axes.patches
    box = band.get_window_extent().transformed(axes.transData.inverted())
    assert (box.x0, box.x1) == pytest.approx((2.5, 3.5))
    assert "failed frame" in legends(configuration(failed))
    assert "1 of 6 frames failed" in title(errors(failed))


def test_axes_carry_units(plan):
    assert set(labels(shapes(plan))) == {"x (mm)", "z (mm)"}
    assert labels(errors(plan))[0].startswith("time (s)")
    assert labels(errors(plan))[1] == "e1 (mm)"
    assert labels(by_frame(plan)) == ["frame", "distance (mm)"]
    assert set(labels(configuration(plan))) == {"α (rad)", "β (mm)", "θ (rad)", "time (s)"}


def test_titles_name_problem_formulation_and_error(plan):
    for picture in (shapes, errors, by_frame, configuration):
        text = title(picture(plan))
        assert ": arc\njoint, " in text
        assert "e3 = " in text


def test_any_name_of_a_problem_can_be_drawn(plan, tmp_path):
    named = plan.meta["problem"] | {"name": "$a_\\frac$ 肺"}
    save_all(dataclasses.replace(plan, meta=plan.meta | {"problem": named}), tmp_path)


def test_the_callers_settings_neither_matter_nor_change(plan):
    with matplotlib.rc_context({"axes.grid": False, "font.size": 30}):
        before = dict(matplotlib.rcParams)
        figure = by_frame(plan)
        assert dict(matplotlib.rcParams) == before
    assert figure.axes[0].yaxis.label.get_size() == 9


def test_a_spatial_motion_is_seen_from_two_sides(spatial):
    assert {"x (mm)", "y (mm)", "z (mm)"} == set(labels(shapes(spatial)))


def test_each_tube_is_drawn_where_it_is_outermost(plan):
    """The motion is planar, so lengths on paper are the tubes' own."""
    figure = shapes(plan, [2, 6])
    for axes, frame in zip(figure.axes, (1, 5), strict=True):
        np.testing.assert_allclose(tube_lengths(axes), np.diff(plan.beta[frame], prepend=0.0), atol=0.02)


def test_shapes_are_to_scale(plan, spatial):
    for figure in (shapes(plan), shapes(spatial)):
        figure.draw_without_rendering()
        for axes in figure.axes:
            box = axes.get_window_extent()
            across, up = np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim())
            assert box.width / across == pytest.approx(box.height / up, rel=1e-6)


def test_a_frame_that_the_plan_does_not_have_is_refused(plan):
    for wrong in (0, 7, -1):
        with pytest.raises(OptionError, match=rf"frames has {wrong}; .* 1 to 6"):
            shapes(plan, [wrong])
    with pytest.raises(OptionError, match="empty"):
        shapes(plan, [])


@pytest.mark.parametrize(("frames", "violins"), [(1, 1), (FRAMES, 6), (23, 10)])
def test_violins_are_at_most_ten_and_hold_all_errors(plan, frames, violins):
    longer = with_frames(plan, frames)
    bodies = [c for c in errors(longer).axes[0].collections if isinstance(c, PolyCollection)]
    bodies = [body for body in bodies if same_color(body.get_facecolor()[0], "#56B4E9")]
    assert len(bodies) == violins
    highest = max(body.get_paths()[0].vertices[:, 1].max() for body in bodies)
    assert highest == pytest.approx(np.linalg.norm(longer.shape - longer.target, axis=-1).max(), abs=1e-6)


def test_the_error_of_the_configuration_is_shown_where_the_truth_is_known(plan):
    assert len(configuration(plan).axes) == 3
    known = configuration(dataclasses.replace(plan, truth=plan.q + 0.01))
    assert [axes.get_ylabel() for axes in known.axes[1::2]] == [
        "error of α (rad)",
        "error of β (mm)",
        "error of θ (rad)",
    ]
    (second,) = [line for line in known.axes[3].lines if line.get_label() == "β2"]
    np.testing.assert_allclose(second.get_ydata(), -0.01, atol=1e-9)


def test_limits_of_beta_are_drawn(plan):
    across = [line for line in configuration(plan).axes[1].lines if list(line.get_xdata()) == [0, 1]]
    heights = {line.get_ydata()[0] for line in across}
    assert heights == {0.0, 50.0, 107.0, 150.0}
    assert configuration(plan).axes[1].get_ylim()[1] > 150.0


def test_whole_turns_do_not_count():
    rng = np.random.default_rng(0)
    small = np.cumsum(rng.uniform(-0.1, 0.1, (40, 3)), axis=0)
    turned = small + 2 * np.pi * rng.integers(-3, 4, (40, 3))
    np.testing.assert_allclose(without_whole_turns(turned), small, atol=1e-12)


def test_an_error_about_half_a_turn_does_not_flicker():
    error = np.pi + 0.01 * np.array([[1.0], [-1.0], [1.0], [-1.0]])
    assert np.abs(np.diff(without_whole_turns(error), axis=0)).max() < 0.03


def test_frames_never_reached_have_no_error_and_spoil_no_other():
    error = np.array([[6.4], [np.nan], [6.3], [0.1]])
    result = without_whole_turns(error)
    assert np.isnan(result[1]).all()
    np.testing.assert_allclose(result[[0, 2, 3], 0], [6.4 - 2 * np.pi, 6.3 - 2 * np.pi, 0.1])


def test_two_ways_to_write_one_rotation_are_one(plan):
    """(alpha, theta_x, theta_y) and (alpha + pi, pi - theta_x, theta_y + pi) give the same shapes."""
    d = plan.robot.d
    theta = np.stack([np.pi - plan.theta[:, 0], plan.theta[:, 1] + np.pi], axis=1)
    other = np.concatenate([plan.alpha + np.pi, plan.beta, theta], axis=1)
    np.testing.assert_allclose(robot_shapes(plan.robot, other), plan.shape, atol=1e-9)
    error = error_from_truth(dataclasses.replace(plan, truth=other))
    np.testing.assert_allclose(error, np.zeros((FRAMES, 2 * d + 2)), atol=1e-9)


def test_a_plan_that_was_saved_is_drawn_alike(plan, tmp_path):
    plan.save(tmp_path / "plan.npz")
    again = Plan.load(tmp_path / "plan.npz")
    assert legends(configuration(again)) == legends(configuration(plan))


FRONT = [
    ParetoPoint("horizon", 1e-8, 0.26, 9000.0, True),
    ParetoPoint("horizon", 1e-2, 0.53, 3500.0, True),
    ParetoPoint("horizon", 1e-5, 9.99, 6000.0, False),
    ParetoPoint("joint:ipopt", 1e-6, 0.29, 10800.0, True),
    ParetoPoint("paper-two-stage", 1e-6, 4.6, 24500.0, False),
]


def test_the_front_is_drawn_through_its_solved_points_from_smooth_to_rough():
    (axes,) = draw_pareto_front(FRONT, "cos").axes
    line = axes.get_lines()[0]
    np.testing.assert_allclose(line.get_xydata(), [[3500.0, 0.53], [9000.0, 0.26]])
    assert [text.get_text() for text in axes.texts] == ["λ = 0.01 s²", "λ = 1e-08 s²"]
    assert axes.get_xlabel() == "roughness (mm²/s)"
    assert axes.get_ylabel() == "e3 (mm)"


def test_other_methods_stand_beside_the_front_and_failures_are_named():
    figure = draw_pareto_front(FRONT, "a name with 漢字")
    (axes,) = figure.axes
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels == ["horizon, by weight λ", "joint:ipopt", "paper-two-stage, not all solved"]
    assert [tuple(line.get_xydata()[0]) for line in axes.get_lines()[1:]] == [(10800.0, 0.29), (24500.0, 4.6)]
    assert "漢" not in figure.get_suptitle()


def test_a_front_of_one_point_or_none_is_drawn(tmp_path):
    for points in (FRONT[:1], FRONT[3:]):
        assert imread(save_pareto_front(points, "cos", tmp_path)).std() > 0


def test_a_front_that_cannot_be_saved_says_so(tmp_path):
    with pytest.raises(OutputError, match="cannot be written"):
        save_pareto_front(FRONT, "cos", tmp_path / "missing")
