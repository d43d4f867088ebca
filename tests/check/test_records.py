"""Parts of the record, each beside small made-up files; and how a plan's verdicts are compared with findings."""

from types import SimpleNamespace

import numpy as np
import pytest

from ctr_nlp.check import checker, comparison, records
from ctr_nlp.check.checker import NO, NOT_COVERED, VERDICTS, YES, Finding
from ctr_nlp.check.plan_file import PlanFile
from ctr_nlp.check.records import RECORDS
from ctr_nlp.check.walls import FieldWall

TOLERANCES = {
    "curvature": 0.02,
    "bending_stiffness": 0.02,
    "torsional_ratio": 0.0,
    "curved_length": 0.0,
    "motor_zero": [0.02, 0.0],
    "rotation_lag": 0.03,
    "diameter": 0.0,
    "tip_force": 0.0,
    "distribution": "uniform",
    "covariance": None,
}


def file_of(arrays=None, digest=None, content="abc", **meta):
    return PlanFile(arrays or {}, {"problem": {}, "model": "elastic"} | meta, digest, content)


def test_digest_is_that_of_the_content():
    assert records._check_digest(file_of()).word == NOT_COVERED
    assert records._check_digest(file_of(digest="abc")).word == YES
    assert records._check_digest(file_of(digest="abd")).word == NO


@pytest.mark.parametrize(
    ("time", "problem", "word"),
    [
        ([1, 2, 3], {"duration": 3.0, "frames": 3}, YES),
        ([1, 2, 3], {"duration": 3.0}, YES),
        ([2], {"duration": 2.0, "frames": 1}, YES),
        ([1, 2, 3], {}, NOT_COVERED),
        ([1, 2, 3], {"duration": 4.0, "frames": 3}, NO),
        ([1, 2, 3], {"duration": 2.0, "frames": 3}, NO),
        ([1, 2, 3], {"duration": 3.0, "frames": 4}, NO),
        ([1, 2, 3.1], {"duration": 3.1, "frames": 3}, NO),
        ([1, 2, 2.9], {"duration": 2.9, "frames": 3}, NO),
    ],
)
def test_times_are_even_and_end_with_the_problem(time, problem, word):
    found = records._check_times(file_of({"time": np.array(time, dtype=float)}, problem=problem))
    assert found.word == word


def axes(problem=None, source=None, **arrays):
    z = np.linspace(0, 30, 101)
    target = np.stack([0 * z, 0 * z, z], axis=-1)[None]
    given = {"to_robot": np.eye(4), "target": target} | arrays
    return records._check_frames_of_reference(file_of(given, problem=problem or {}), source)


def lumen(radius=5.0, shift=0.0):
    z = np.linspace(-5, 40, 91)
    return np.stack([0 * z + shift, 0 * z, z, 0 * z + radius], axis=-1)


def test_axes_are_rigid_and_target_lies_on_lumen(tmp_path):
    assert axes().word == NOT_COVERED
    mirrored = np.diag([1.0, -1, 1, 1])
    assert axes(to_robot=mirrored).word == NO
    assert axes({"space": "LAS"}, to_robot=mirrored).word == NOT_COVERED
    assert axes({"space": "LAS"}).word == NO
    assert axes(to_robot=np.diag([1.01, 1, 1, 1])).word == NO
    radius = np.full((1, 101), 5.0)
    assert axes(lumen=lumen(), lumen_radius=radius).word == NOT_COVERED
    assert axes(lumen=lumen(), lumen_radius=radius + 0.2).word == NO
    assert axes(lumen=lumen(), lumen_radius=radius - 0.2).word == NO
    assert axes({"deviation": 0.2}, lumen=lumen(), lumen_radius=radius + 0.2).word == NOT_COVERED
    assert axes(lumen=lumen(shift=4.5)).word == NOT_COVERED  # targets without radii are inside
    assert axes(lumen=lumen(shift=5.5)).word == NO
    source = tmp_path / "path.csv"
    source.write_text("x_mm,y_mm,z_mm\n0,0,0\n0,0,15\n0,0,30\n")
    assert axes(source=source).word == YES
    source.write_text("x_mm,y_mm,z_mm\n0,0,0\n0,3,15\n0,6,30\n")
    assert axes(source=source).word == NO
    for aside, word in ((0.09, YES), (0.12, NO)):
        rows = "".join(f"{aside},0,{z}\n" for z in range(31))
        source.write_text(f"x_mm,y_mm,z_mm\n{rows}")
        assert axes(source=source).word == word
    markups = tmp_path / "path.mrk.json"
    points = ", ".join(f'{{"position": [0, 0, {z}]}}' for z in (0, 15, 30))
    markups.write_text(f'{{"markups": [{{"controlPoints": [{points}]}}]}}')
    assert axes(source=markups).word == YES


class Body(FieldWall):
    """A body that leaves the same room everywhere, mm."""

    def __init__(self, room, kept_out=False):
        self.kept_out = kept_out
        self._room = room

    def left_exactly(self, points):
        return np.full(len(points), self._room)


def test_target_stays_inside_of_bodies():
    target = np.zeros((1, 101, 3))
    for walls, problem, word in (
        ([Body(-0.9)], {}, NOT_COVERED),  # voxels are about a millimetre large
        ([Body(-1.1)], {}, NO),
        ([Body(-1.1)], {"deviation": 0.6}, NOT_COVERED),
        ([Body(-9.0, kept_out=True)], {}, NOT_COVERED),
        ([Body(-9.0, kept_out=True), Body(-1.1)], {}, NO),
    ):
        file = file_of({"to_robot": np.eye(4), "target": target}, problem=problem)
        file.__dict__["walls"] = walls
        found = records._check_frames_of_reference(file, None)
        assert found.word == word
        if word == NO:
            assert found.why == "Targets are outside of the wall by 0.10 mm more than they may."


def samples(scale=1.0, count=400, **changes):
    random = np.random.default_rng(1)
    bands = np.zeros((2, 5))
    bands[:, :2] = 0.02
    bands[0, 4] = 0.02
    parts = random.uniform(-1, 1, (count, 2, 5)) * bands * scale
    lags = random.uniform(0, 1, (count, 2)) * 0.03
    robot = {"tubes": [{}, {}], "tolerances": TOLERANCES | changes}
    return file_of({"draws_parts": parts, "draws_lags": lags}, robot=robot)


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({}, ""),
        ({"curvature": 0.01}, "curvature"),
        ({"curvature": 0.03}, "curvature"),
        ({"motor_zero": 0.02}, "motor_zero"),
        ({"curved_length": 0.1}, "curved_length"),
        ({"rotation_lag": 0.01}, "rotation_lag"),
        ({"rotation_lag": 0.06}, "rotation_lag"),
        ({"bending_stiffness": 0.01, "diameter": 0.05}, ""),
    ],
)
def test_samples_must_fill_their_tolerances(changes, names):
    found = records._check_tolerances(samples(**changes))
    assert found.word == (NO if names else YES)
    assert names in found.why
    assert records._check_tolerances(file_of(robot=samples().meta["robot"])).word == NOT_COVERED


def test_normal_samples_must_have_their_variance():
    assert records._check_tolerances(samples(distribution="normal")).word == YES
    wide = records._check_tolerances(samples(scale=1.5, distribution="normal"))
    narrow = records._check_tolerances(samples(scale=0.6, distribution="normal"))
    assert wide.word == narrow.word == NO
    file = samples(distribution="normal")
    random = np.random.default_rng(2)
    file.arrays["draws_parts"] = (
        random.normal(size=(400, 2, 5)) * checker.read_bands(TOLERANCES, 2)[:, :5] / np.sqrt(3)
    )
    assert records._check_tolerances(file).word == YES  # some are beyond the bands of uniform ones
    variance = np.zeros(10)
    variance[[0, 1, 4, 5, 6]] = 0.02**2 / 3
    covariance = np.diag(variance).tolist()
    assert records._check_tolerances(samples(distribution="normal", covariance=covariance)).word == YES
    assert records._check_tolerances(samples(scale=1.5, distribution="normal", covariance=covariance)).word == NO


def cloud(tip=0.0):
    """Points of three samples in three frames, of which the last tips are compared: (3, 3, 26, 3), mm."""
    points = np.full((3, 3, 26, 3), 9.0)
    points[-1, :, -1] = tip
    return points


def result(moved=3, **changes):
    """Three samples that are found as they are recorded."""
    arrays = {
        "draws_parts": np.zeros((3, 1, 5)),
        "draws_lost": np.array([0, 0, 0]),
        "draws_clearance": np.array([1.0, -0.3, 0.2]),
        "draws_cloud": cloud(),
        "draws_e2": np.full((3, 2), 0.5),
    } | changes
    return SimpleNamespace(
        file=file_of(arrays),
        findings={"holds": Finding(YES, why="Because.")},
        moved=moved,
        samples={
            "lost": np.zeros(3, dtype=bool),
            "tips": np.zeros((3, 3)),
            "contacts": np.array([-1.0, 0.3, -0.2]),
            "errors": np.full((3, 2), 0.5),
        },
    )


def test_results_of_samples_are_compared_one_by_one():
    assert records._check_samples(result()) == Finding(YES, 0.0, why="0 of 3 samples differ: none.")
    uncovered = result(moved=0)
    assert records._check_samples(uncovered) == Finding(NOT_COVERED, why="Because.")
    uncovered.findings["holds"] = Finding(YES)
    assert records._check_samples(uncovered) == Finding(NOT_COVERED, why="No recorded samples were moved.")
    without = result()
    del without.file.arrays["draws_parts"]
    assert records._check_samples(without).word == NOT_COVERED
    assert records._check_samples(result(draws_lost=np.array([1, 0, 0]))).word == YES  # one may differ
    lost = records._check_samples(result(draws_lost=np.array([1, 2, 0])))
    assert lost == Finding(NO, 2.0, why="2 of 3 samples differ: outcomes of 2.")
    both = records._check_samples(result(draws_lost=np.array([1, 2, 0]), draws_cloud=cloud(0.2)))
    assert both == Finding(NO, 3.0, why="3 of 3 samples differ: tips of 1, outcomes of 2.")
    assert records._check_samples(result(draws_clearance=np.array([1.0, 0.0, -0.4]))).word == NO
    assert records._check_samples(result(draws_clearance=np.full(3, np.nan))).word == YES
    assert records._check_samples(result(draws_cloud=cloud(0.2))).word == NO
    assert records._check_samples(result(draws_cloud=cloud(np.nan))).word == NO
    assert records._check_samples(result(draws_e2=np.full((3, 2), 0.7))).word == NO
    assert records._check_samples(result(draws_e2=np.full((3, 2), 0.3))).word == NO


@pytest.mark.parametrize(("count", "off", "word"), [(3, 1, YES), (3, 2, NO), (150, 3, YES), (150, 4, NO)])
def test_one_sample_or_two_percent_may_differ(count, off, word):
    recorded = {"draws_lost": np.arange(count) < off, "draws_clearance": np.ones(count)}
    recorded |= {"draws_cloud": np.zeros((1, count, 2, 3)), "draws_e2": np.zeros((count, 2))}
    found = result(moved=count, **recorded)
    found.samples = {"lost": np.zeros(count, dtype=bool), "tips": np.zeros((count, 3))}
    found.samples |= {"contacts": np.zeros(count), "errors": np.zeros((count, 2))}
    assert records._check_samples(found) == Finding(
        word, float(off), why=f"{off} of {count} samples differ: outcomes of {off}."
    )


def test_recorded_values_are_compared_where_others_were_found():
    own = np.array([[1.0, 2.0], [np.nan, 4.0]])
    assert records._compare("clearances", own, own, 0.1).word == YES
    assert records._compare("clearances", own + 0.09, own, 0.1).word == YES
    far = records._compare("clearances", own - [[0.0, 0.0], [0.0, 0.3]], own, 0.1, " mm")
    assert far.word == NO
    assert far.number == pytest.approx(0.3)
    assert far.distance == pytest.approx(-0.2)
    assert far.why == "Recorded clearances differ by 0.3 mm, most in frame 2; 0.1 mm is allowed."
    each = np.array([[0.1, 0.3], [0.1, 0.3]])  # allowed, of each value
    assert records._compare("clearances", own + np.array([0.0, 0.2]), own, each).word == YES
    assert records._compare("clearances", own + np.array([0.2, 0.0]), own, each).word == NO
    assert records._compare("shapes", np.full((2, 2), np.nan), own, 0.1).word == NO
    assert records._compare("shapes", own, np.full((2, 2), np.nan), 0.1).word == NOT_COVERED


TUBE = {"length": 90.0, "curved_length": 50.0, "curvature": 0.0, "outer_diameter": 2.0, "inner_diameter": 1.0}
TUBE |= {"poisson_ratio": 0.3, "youngs_modulus": 1.0}


def motion(meta=None, margin=None, **changes):
    """A straight robot of one tube that goes along a lumen of 5 mm in four frames, found as it is recorded.

    Margins fall within each frame; on the way to the third frame the robot is nearer to the wall.
    """
    sigma = np.linspace(0, 1, 101)
    beta = np.array([10.0, 20.0, 30.0, 40.0])
    shape = np.zeros((4, 101, 3))
    shape[..., 2] = beta[:, None] * sigma
    margins = np.linspace(0.9, 0.6, 10) + np.zeros((4, 1)) if margin is None else np.array(margin)
    clearance = np.full((4, 10, 101), 4.0)
    clearance[2, 4] = 3.0
    arrays = {
        "beta": beta[:, None],
        "shape": shape.copy(),
        "stability": margins[:, -1].copy(),
        "stability_between": margins.min(axis=1),
        "lumen": lumen(),
        "clearance": clearance[:, -1].copy(),
        "clearance_between": clearance.min(axis=1),
    }
    return SimpleNamespace(
        file=file_of(arrays | changes, robot={"tubes": [TUBE]}, **(meta or {})),
        findings={"stable": Finding(YES, why="Because.")},
        shape=shape,
        margin=margins,
        clearance=clearance,
        e2=np.where(np.isnan(margins[:, -1]), np.nan, 0.0),
    )


def words_of_motion(*given, **changes):
    return [finding.word for finding in records._check_motion(motion(*given, **changes))]


def test_shapes_margins_and_clearances_are_compared():
    assert words_of_motion() == [YES, YES, YES]
    own = motion().file.arrays
    moved = own["shape"] + [0.0, 0.0, 0.06]
    assert words_of_motion(shape=moved) == [NO, YES, YES]
    assert words_of_motion(shape=own["shape"] + [0.0, 0.0, 0.04]) == [YES, YES, YES]
    for name in ("stability", "stability_between"):
        # 0.002 and 0.5 % of the margin are allowed.
        assert words_of_motion(**{name: 1.005 * own[name] + 0.0025}) == [YES, NO, YES]
        assert words_of_motion(**{name: 0.995 * own[name] - 0.0015}) == [YES, YES, YES]
    for name in ("clearance", "clearance_between"):
        assert words_of_motion(**{name: own[name] + 0.2}) == [YES, YES, NO]
        assert words_of_motion(**{name: own[name] - 0.05}) == [YES, YES, YES]
    assert words_of_motion(clearance=own["clearance"] * np.nan) == [YES, YES, NO]


def test_a_wall_and_its_clearances_belong_together():
    for missing, word in ((("lumen",), NO), (("clearance",), NO), (("lumen", "clearance"), NOT_COVERED)):
        why = "The file has no wall." if "lumen" in missing else "The file has a wall, and no clearances."
        found = motion()
        for name in missing:
            del found.file.arrays[name]
        assert records._check_motion(found)[2] == Finding(word, why=why)
    without_between = motion()
    del without_between.file.arrays["clearance_between"]
    assert records._check_motion(without_between)[2].word == YES


def test_clearances_away_from_the_nearest_place_may_be_smoothed():
    clearance = motion().file.arrays["clearance"]
    away, near = clearance.copy(), clearance.copy()
    found = motion()
    found.clearance[..., 50:] -= 0.5  # half of the robot is nearer to the wall than the other half
    away[:, :50] += 0.4
    away[:, 50:] -= 0.5
    near[:, 50:] -= 0.1
    between = found.file.arrays["clearance_between"]
    between[:, 50:] -= 0.5
    for recorded, word in ((away, YES), (near, NO), (away - 0.55, NO)):
        found.file.arrays["clearance"] = recorded
        assert records._check_motion(found)[2].word == word


def test_frames_after_a_bifurcation_are_not_compared():
    margin = np.full((4, 10), 0.5)
    margin[2, 3] = 0.005
    wrong = motion().file.arrays["shape"].copy()
    wrong[2:] += 1.0
    assert words_of_motion(margin=margin, shape=wrong)[:2] == [YES, YES]
    wrong[1] += 1.0
    assert words_of_motion(margin=margin, shape=wrong)[0] == NO
    for frame, word in ((2, YES), (3, NO), (1, NOT_COVERED)):
        snapped = np.full((4, 10), 0.5)
        snapped[frame - 1 :] = np.nan
        snapped[frame - 1, :3] = 0.5
        assert words_of_motion(margin=snapped, shape=wrong)[0] == word


def test_other_models_have_no_margins():
    nan = np.full(4, np.nan)
    assert words_of_motion({"evaluated": "mine"}) == [NOT_COVERED] * 3
    found = motion()
    found.margin = found.margin * np.nan
    assert [each.why for each in records._check_motion(found)] == ["Because."] * 3
    on_elastic = records._check_motion(motion(stability=nan))
    assert [each.word for each in on_elastic[:2]] == [YES, NOT_COVERED]


def test_way_to_a_frame_is_the_one_that_was_planned():
    values = np.arange(30.0, 0.0, -1.0).reshape(3, 10)
    ways = {"reversed": False}, {"reversed": True}, {"stretch": {"first": 2}}, {"stretch": {"first": 1}}
    least = [records.find_least_on_way(file_of(**meta), values).tolist() for meta in ways]
    # Backwards, the sub-steps between two frames begin with the first of them, and end before the second.
    assert least[0] == least[3] == [21.0, 11.0, 1.0]
    assert least[1] == [22.0, 12.0, 2.0]
    assert np.isnan(least[2][0])
    assert least[2][1:] == [11.0, 1.0]


def compared(name, word, number, finding, **changes):
    findings = dict.fromkeys((*VERDICTS, *RECORDS), Finding(YES, 1.0, 1.0)) | {name: finding}
    arrays = {"stability": np.array(changes.get("stability", [0.5])), "draws_parts": np.zeros((40, 1, 5))}
    moved = changes.get("moved", 40)
    found = SimpleNamespace(
        file=file_of(arrays, **changes.get("meta", {})),
        findings=findings,
        snaps=changes.get("snaps", []),
        moved=moved,
        borderline=changes.get("borderline", 0),
    )
    own = {name: SimpleNamespace(word=word, number=number)}
    opinions = {each.name: each for each in comparison.compare_verdicts(found, own)}
    assert list(opinions) == [*VERDICTS, *RECORDS]
    assert opinions[name].own_word == word
    return opinions[name].agrees


def test_words_may_differ_near_the_threshold_alone():
    assert compared("arrives", YES, 1.0, Finding(YES, 1.0, 1.0))
    assert not compared("arrives", YES, 1.9, Finding(NO, 2.1, -0.1))
    assert compared("arrives", YES, 1.99, Finding(NO, 2.01, -0.01))
    assert not compared("arrives", NO, 2.3, Finding(YES, 1.9, 0.1))
    assert not compared("within_limits", YES, 99.0, Finding(NO, 101.0, -1e-7))
    assert not compared("solved", YES, 10, Finding(NO, 9.0))
    assert compared("arrives", "NOT CHECKED", 9.0, Finding(NO, 9.0, -7.0))
    assert compared("arrives", YES, 1.0, Finding(NOT_COVERED))


def test_numbers_may_differ_by_their_tolerance():
    assert compared("follows", YES, 1.0, Finding(YES, 1.04, 0.96))
    assert not compared("follows", YES, 1.0, Finding(YES, 1.1, 0.9))
    assert not compared("stable", YES, 0.20, Finding(YES, 0.21, 0.1))
    assert compared("stable", NO, 0.0, Finding(NO, 0.21), snaps=[3])
    assert compared("within_limits", YES, 50.0, Finding(YES, 60.0, 1.0))
    assert compared("within_wall", YES, 0.0, Finding(YES, 0.0, 3.5))
    assert not compared("within_wall", NO, 1.0, Finding(NO, 1.3, -0.8))
    assert compared("within_wall", NO, 20.0, Finding(NO, 25.0, -24.5))
    assert not compared("within_wall", NO, 1.0, Finding(NO, 25.0, -24.5))
    assert compared("holds", NO, 0.5, Finding(NO, 0.525, -0.425))  # one of 40 samples
    assert not compared("holds", NO, 0.5, Finding(NO, 0.55, -0.4))
    assert compared("holds", YES, 0.95, Finding(NO, 0.925, -0.025))
    assert not compared("holds", YES, 0.95, Finding(NO, 0.9, -0.05))
    assert compared("holds", NO, 0.5, Finding(NO, 0.75, -0.2), moved=4)
    assert not compared("follows", YES, 1.0, Finding(YES, 1.1, 0.9), moved=4)
    # Samples whose contact or tip lies at the limit, and one more, may count in one view alone.
    assert compared("holds", NO, 0.5, Finding(NO, 0.6, -0.35), borderline=3)
    assert not compared("holds", NO, 0.5, Finding(NO, 0.6, -0.35), borderline=2)


def judged_samples(tips, contacts, lost=None, why="", **options):
    """The result on samples whose tips end this far from the target's end, with these contacts, mm."""
    tips = np.array(tips)[:, None] * np.array([1.0, 0.0, 0.0])
    samples = {"lost": np.array(lost or [False] * len(tips)), "tips": tips, "contacts": np.array(contacts)}
    # The target of the last frame ends in the origin; nothing else of it is near.
    target = np.linspace([0.0, 0.0, -100.0], [0.0, 0.0, 0.0], 101) + np.array([[[50.0, 0, 0]], [[0.0, 0, 0]]])
    file = file_of({"target": target}, options=options)
    found = checker._judge_samples(checker.CheckResult(file, {"arrives": Finding(YES, why=why)}), samples)
    return found.findings["holds"], found


def test_samples_that_arrive_without_pressing_hold():
    finding, found = judged_samples(
        [0.0, 1.9, 2.1, 0.0, np.nan], [0.0, -1.0, 0.0, 1.3, np.nan], [False] * 4 + [True]
    )
    assert (finding.word, finding.number, finding.distance) == (NO, pytest.approx(0.4), pytest.approx(-0.55))
    assert finding.why == "1 of 5 are lost, 1 miss, 1 press."
    assert found.samples["missed"].tolist() == [False, False, True, False, False]
    assert found.samples["pressed"].tolist() == [False, False, False, True, False]
    assert (found.moved, found.borderline) == (5, 2)  # 0.1 mm from the limit of arrival
    finding, found = judged_samples([0.0] * 4, [0.9, 1.1, 1.2, np.nan], contact_allowed=0.1)
    assert (finding.number, found.borderline) == (0.5, 2)
    assert judged_samples([0.0] * 2, [1.2, 0.0], contact_allowed=1.3)[0].word == YES
    assert judged_samples([0.0, 2.5], [0.0, 0.0], share=0.5)[0] == Finding(
        YES, 0.5, 0.0, "0 of 2 are lost, 1 miss, 0 press."
    )
    assert judged_samples([2.5], [0.0], arrival_tolerance=3.0)[0].word == YES
    assert judged_samples([0.0], [0.0], why=checker.DETOUR)[0].number == 0.0


def test_later_part_may_count_the_way_to_its_first_frame():
    later = {"stretch": {"first": 3}}
    assert compared("stable", YES, 0.2, Finding(YES, 0.3, 0.2), meta=later)
    assert not compared("stable", YES, 0.3, Finding(YES, 0.2, 0.1), meta=later)
    assert not compared("stable", YES, 0.2, Finding(YES, 0.3, 0.2), meta={"stretch": {"first": 1}})
    assert compared("within_wall", NO, 1.0, Finding(YES, 0.3, 0.2), meta=later)
    assert not compared("within_wall", YES, 0.3, Finding(NO, 1.0, -0.5), meta=later)
    assert not compared("follows", YES, 1.2, Finding(YES, 1.0, 1.0), meta=later)


def test_numbers_on_another_model_are_not_compared():
    nan = [np.nan]
    assert compared("arrives", NO, 9.0, Finding(YES, 1.0, 1.0), stability=nan)
    assert not compared("solved", NO, 9, Finding(YES, 10.0), stability=nan)


def test_record_that_does_not_fit_is_a_disagreement():
    findings = dict.fromkeys((*VERDICTS, *RECORDS), Finding(NOT_COVERED)) | {
        "shapes": Finding(NO),
        "holds": Finding(NO),
    }
    found = SimpleNamespace(file=file_of({"stability": np.zeros(1)}), findings=findings, snaps=[], moved=0)
    assert [each.name for each in comparison.compare_verdicts(found, {}) if not each.agrees] == ["shapes"]


@pytest.mark.parametrize(
    ("success", "kkt", "interpolated", "word"),
    [
        ([True, True], [0.0, 1e-3], [], YES),
        ([True, True], [0.0, 0.1], [], NO),
        ([True, False], [0.0, 0.0], [], NO),
        ([True, False], [0.0, np.nan], [2], NOT_COVERED),
        ([True, True], [0.0, np.nan], [], NOT_COVERED),
    ],
)
def test_frames_must_be_solved_with_small_residuals(success, kkt, interpolated, word):
    file = file_of({"success": np.array(success), "kkt": np.array(kkt)}, interpolated=interpolated)
    assert checker._judge_solved(file).word == word


@pytest.mark.parametrize(
    ("margin", "snaps", "asked", "word"),
    [
        ([[0.5, 0.2]], [], 0.0, YES),
        ([[0.5, 0.2]], [], 0.2, YES),
        ([[0.5, 0.2]], [], 0.203, YES),
        ([[0.5, 0.2]], [], 0.21, NO),
        ([[0.5, 0.0005]], [], 0.0, NO),
        ([[0.5, 0.4]], [7], 0.0, NO),
        ([[0.5, 0.4], [np.nan, np.nan]], [2], 0.0, NO),
        ([[np.nan, np.nan]], [1], 0.0, NO),
    ],
)
def test_stability_needs_the_margin_everywhere(margin, snaps, asked, word):
    assert checker._judge_stability(np.array(margin), snaps, asked).word == word


@pytest.mark.parametrize(
    ("options", "least"), [({}, 0.1), ({"stability_margin": None}, 0.0), ({"stability_margin": 0.3}, 0.3)]
)
def test_least_margin_is_the_one_asked_for_or_the_default(options, least):
    assert checker.threshold(file_of(options=options), "stability_margin") == least


def test_a_number_that_one_side_does_not_have_is_not_compared():
    assert compared("arrives", YES, None, Finding(YES, 1.0, 1.0))
    assert compared("arrives", YES, 1.0, Finding(YES))
