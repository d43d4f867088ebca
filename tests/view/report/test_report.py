"""The page of one or more plans, read as a file and opened in a real browser."""

import dataclasses
import html
import json
import re
import subprocess
import sys

import numpy as np
import pytest
from browser import NO_GRAPHICS, SOFTWARE, changed, launcher, opened, pixels, share_of_hue
from matplotlib.colors import to_rgb

from ctr_nlp import Plan, Problem, curve_from_formula, growing, solve_per_frame, table_i_robot
from ctr_nlp.cli.commands import report as make_report
from ctr_nlp.paths.lumen import Lumen
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.plan.metrics import by_frame, e1, summary
from ctr_nlp.view.figures.parts.palette import CONTACT, TUBE_COLOURS
from ctr_nlp.view.report import page
from ctr_nlp.view.report.scene import quantities, scales

FRAMES = 8
PLOTS = 11
"""Of a plan whose wall and margin are known."""
WIDTHS = (1280, 390)


def bend(u):
    return 0.004 * u**2, 0.001 * u**2, u


@pytest.fixture(scope="module")
def plain():
    target = growing(curve_from_formula(bend, 0.0, 110.0), 5)
    return solve_per_frame(Problem("bend", table_i_robot(), target), model="dominant", direction="forward")


@pytest.fixture(scope="module")
def walled():
    """With a wall that the robot leaves in its last frame, and a margin that falls."""
    target = growing(curve_from_formula(bend, 0.0, 120.0), FRAMES)
    plan = solve_per_frame(
        Problem("walled </script> & <b>", table_i_robot(), target), model="dominant", direction="forward"
    )
    radius = np.linspace(9.0, 1.0, len(SIGMA_GRID))
    lumen = np.column_stack([plan.target[-1], radius])
    clearance = Lumen(lumen).clearance(plan.robot, plan.beta, SIGMA_GRID, plan.shape)
    margin = np.linspace(0.9, 0.1, FRAMES)
    return dataclasses.replace(plan, lumen=lumen, clearance=clearance, stability=margin, stability_between=margin)


@pytest.fixture(scope="module")
def launch():
    with launcher() as found:
        yield found


@pytest.fixture(scope="module")
def browser(launch):
    found = launch(SOFTWARE)
    yield found
    found.close()


@pytest.fixture(scope="module")
def file(walled, tmp_path_factory):
    return written(page([walled], ["one/plan.npz"]), tmp_path_factory)


@pytest.fixture(scope="module")
def both(walled, plain, tmp_path_factory):
    return written(page([walled, plain], ["one/plan.npz", "other/plan.npz"]), tmp_path_factory)


@pytest.fixture(scope="module")
def wide(browser, file):
    """The page in a wide window; tests go to a frame, and to a colouring, by themselves."""
    with opened(browser, file, WIDTHS[0]) as view:
        wait_for_scenes(view)
        yield view


def written(text, factory):
    path = factory.mktemp("page") / "report.html"
    path.write_text(text, encoding="utf-8")
    return path


def test_the_page_says_every_verdict_in_the_plans_own_words(walled, plain):
    """The wall is left by up to 1.9 mm, the plain plan knows of none."""
    text = page([walled, plain])
    tables = re.findall(r'<table class="verdicts">(.*?)</table>', text, re.S)
    assert len(tables) == 2
    for plan, table in zip((walled, plain), tables, strict=True):
        cells = [[html.unescape(cell) for cell in re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row)]
                 for row in table.splitlines() if "<tr" in row]  # fmt: skip
        assert [(matter, word, why) for matter, word, _, why in cells] == [
            (verdict.matter, verdict.word, verdict.why) for verdict in plan.verdicts
        ]
    assert walled.verdicts.within_wall.word == "no"
    assert plain.verdicts.within_wall.word == "NOT CHECKED"


def data_of(text):
    return json.loads(re.search(r'<script id="data" type="application/json">(.*?)</script>', text, re.S)[1])


def wait_for_scenes(view):
    view.wait_for_function("scenes.every((scene) => scene)")
    settle(view)


def settle(view):
    """Until everything that was asked for is drawn."""
    view.evaluate("() => new Promise((done) => setTimeout(done, 400))")


def go_to(view, frame):
    slider = view.locator("#frame")
    slider.fill(str(frame))
    settle(view)


def cursors(view):
    """Times at which the cursors of every plan stand, by where they are drawn."""
    return view.evaluate(
        "plots.map((places, k) => places.map((place) => place.querySelector('.axes')).map((axes, p) => {"
        "  const [box, cursor] = [axes.querySelector('svg'), axes.querySelector('.cursor')].map("
        "    (part) => part.getBoundingClientRect());"
        "  const part = (cursor.x + cursor.width / 2 - box.x) / box.width;"
        "  return Number((part * report.plans[k].plots[p].end).toFixed(1)); }))"
    )


def at(time, plots):
    """What cursors tells where those of so many plots stand at a time in s, to a pixel or so."""
    return [round(float(time), 1)] * plots


def scene_of(view, k=0):
    return pixels(view.locator(".scene").nth(k).screenshot())


def test_a_page_is_one_small_file_that_asks_for_nothing(file, walled):
    text = file.read_text(encoding="utf-8")
    assert len(text) < 5e6
    outside = re.sub(r"<script.*?</script>", "", text, flags=re.S)
    assert not re.findall(r'(?:src|href)\s*=\s*"(?!#)', outside)
    assert "url(" not in outside
    assert html.escape("walled </script> & <b>") in text
    assert "<b>" not in outside
    numbers = json.loads(html.unescape(re.search(r"<pre[^>]*>(.*?)</pre>", text, re.S)[1]))
    assert numbers == json.loads(json.dumps(summary(walled)))


def test_the_readout_is_that_of_errors_csv(file, walled):
    shown, columns = data_of(file.read_text(encoding="utf-8"))["plans"][0], by_frame(walled)
    assert list(shown["readout"]) == [
        "e2",
        "max",
        "clearance",
        "stability",
        "stability_between",
    ]
    for name, told in shown["readout"].items():
        np.testing.assert_allclose(told["values"], columns[name], rtol=1e-3)
    np.testing.assert_array_equal(shown["time"], walled.time)


def test_scales_are_common_to_plans_and_begin_where_contact_does(walled, plain):
    assert [scale.key for scale in scales([plain])] == ["error"]
    error, clearance, stability = scales([walled, plain])
    assert error.high == pytest.approx(max(e1(walled).max(), e1(plain).max()))
    assert clearance.high == pytest.approx(walled.clearance.max())
    assert stability.high == 1.0
    for scale in (clearance, stability):
        zero = -scale.low / (scale.high - scale.low)
        assert [colour for at, colour in scale.stops if at < zero - 1e-9] == [CONTACT]
        assert [colour for at, colour in scale.stops if at > zero + 1e-9].count(CONTACT) == 0
        assert [at for at, _ in scale.stops] == sorted(at for at, _ in scale.stops)
    assert set(quantities(plain)) == {"error"}


@pytest.mark.parametrize("width", WIDTHS)
def test_the_scene_shows_the_tubes_and_moves_with_the_slider(browser, file, walled, width):
    with opened(browser, file, width) as view:
        wait_for_scenes(view)
        go_to(view, 2)
        before, plots = scene_of(view), view.locator(".plots").screenshot()
        readout = view.locator(".readout").inner_text()
        assert cursors(view) == [at(walled.time[1], PLOTS)]
        go_to(view, FRAMES)
        after = scene_of(view)
        assert cursors(view) == [at(walled.time[-1], PLOTS)]
        assert changed(after, before) > 0.005
        assert view.locator(".plots").screenshot() != plots
        for colour in TUBE_COLOURS[:3]:
            assert share_of_hue(after, to_rgb(colour)) > 3e-4
        told = view.locator(".readout").inner_text()
        assert told != readout
        assert f"frame {FRAMES} of {FRAMES}" in told
        assert f"e2 {by_frame(walled)['e2'][-1]:.3g} mm" in told
        assert view.evaluate("document.documentElement.scrollWidth") <= width


def test_colours_show_where_the_wall_is_touched(wide):
    view = wide
    go_to(view, FRAMES)
    contact = to_rgb(CONTACT)
    assert share_of_hue(scene_of(view), contact, 0.02) < 1e-4
    view.select_option("#colouring", "clearance")
    settle(view)
    assert share_of_hue(scene_of(view), contact, 0.02) > 2e-4
    assert share_of_hue(scene_of(view), to_rgb(TUBE_COLOURS[2])) < 1e-4
    assert "contact below 0" in view.locator(".legends").inner_text()
    go_to(view, 2)
    assert share_of_hue(scene_of(view), contact, 0.02) < 1e-4
    looks = {}
    for key in ("error", "stability", "tube"):
        view.select_option("#colouring", key)
        settle(view)
        looks[key] = view.locator(".scene").screenshot()
    assert len(set(looks.values())) == 3


def test_the_tip_sees_a_pink_wall_that_darkens_with_depth(wide):
    view = wide
    view.select_option("#colouring", "tube")
    go_to(view, 3)
    outside = scene_of(view)
    view.get_by_role("button", name="Tip's eye").click()
    settle(view)
    inside = scene_of(view)[20:-60, 20:-20]
    red, green = inside[..., 0], inside[..., 1]
    lit = red > 0.3
    assert lit.mean() > 0.1
    assert (red[lit] > 1.2 * green[lit]).mean() > 0.9
    assert inside.max(axis=-1).min() < 0.2
    view.get_by_role("button", name="Side").click()
    settle(view)
    assert changed(scene_of(view), outside) < 1e-3


def test_playing_runs_to_the_end_and_stops_on_demand(wide, walled):
    view = wide
    go_to(view, 1)
    play = view.get_by_role("button", name="Play")
    play.click()
    view.wait_for_function("slider.value > 2")
    view.get_by_role("button", name="Pause").click()
    settle(view)
    stopped = view.input_value("#frame")
    settle(view)
    assert view.input_value("#frame") == stopped
    go_to(view, FRAMES - 1)
    play.click()
    view.wait_for_function("playing === null")
    assert cursors(view) == [at(walled.time[-1], PLOTS)]


def test_a_tap_on_a_plot_moves_the_frame(wide, walled):
    view = wide
    go_to(view, 1)
    box = view.locator(".axes").first.bounding_box()
    view.mouse.click(box["x"] + 0.55 * box["width"], box["y"] + 0.6 * box["height"])
    settle(view)
    assert 2 < int(view.input_value("#frame")) < FRAMES
    assert cursors(view) == [at(walled.time[int(view.input_value("#frame")) - 1], PLOTS)]


def test_several_plans_move_in_step_whatever_their_frames(browser, both, walled, plain):
    with opened(browser, both, 1280) as view:
        wait_for_scenes(view)
        boxes = [view.locator(".scene").nth(k).bounding_box() for k in (0, 1)]
        assert boxes[0]["y"] == boxes[1]["y"]
        assert boxes[0]["x"] + boxes[0]["width"] <= boxes[1]["x"]
        for frame, other in ((1, 1), (5, 3), (8, 5)):
            go_to(view, frame)
            first, second = cursors(view)
            assert set(first) == set(at(walled.time[frame - 1], 1))
            assert set(second) == set(at(plain.time[other - 1], 1))
        assert view.locator(".absent").count() == 2
        go_to(view, FRAMES)
        for k in (0, 1):
            assert share_of_hue(scene_of(view, k), to_rgb(TUBE_COLOURS[0])) > 3e-4
        other = scene_of(view, 1)
        view.locator(".scene").first.scroll_into_view_if_needed()  # a mouse moves over what is on the screen
        box = view.locator(".scene").first.bounding_box()
        before = view.evaluate("String(cameraOf(scenes[1]))")
        view.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        view.mouse.down()
        view.mouse.move(box["x"] + box["width"] / 2 + 120, box["y"] + box["height"] / 2, steps=6)
        # The controls turn the view when they draw: on a busy machine that may be a while after the mouse moved.
        view.wait_for_function("(before) => String(cameraOf(scenes[1])) !== before", arg=before)
        view.mouse.up()
        assert changed(scene_of(view, 1), other) > 0.005


def test_frames_that_were_not_reached_are_said_and_drawn_empty(browser, walled, tmp_path_factory):
    def hollow(array):
        found = np.array(array, dtype=float)
        found[-2:] = np.nan
        return found

    names = ("alpha", "beta", "theta", "shape", "clearance", "stability", "stability_between", "tip_direction")
    arrays = {name: hollow(getattr(walled, name)) for name in names}
    success = walled.success & (np.arange(FRAMES) < FRAMES - 2)
    file = written(page([dataclasses.replace(walled, success=success, **arrays)]), tmp_path_factory)
    with opened(browser, file, 1280) as view:
        wait_for_scenes(view)
        go_to(view, FRAMES)
        assert view.locator(".readout").inner_text().endswith("not reached")
        assert share_of_hue(scene_of(view), to_rgb(TUBE_COLOURS[0])) < 1e-4
        go_to(view, FRAMES - 2)
        assert share_of_hue(scene_of(view), to_rgb(TUBE_COLOURS[0])) > 3e-4


def test_without_webgl_the_page_says_so_and_plots_work(launch, file, walled):
    with launch(NO_GRAPHICS) as browser, opened(browser, file, 1280) as view:
        view.locator(".missing").wait_for()
        assert "WebGL" in view.locator(".scene").inner_text()
        view.locator("#frame").fill("5")
        assert cursors(view) == [at(walled.time[4], PLOTS)]
        assert "frame 5" in view.locator(".readout").inner_text()


def test_the_program_writes_a_page_whole_or_not_at_all(plain, tmp_path, capsys):
    plan, out = tmp_path / "plan.npz", tmp_path / "report"
    plain.save(plan)
    assert make_report.main([str(plan), "--out", str(out)]) == 0
    assert "report.html" in capsys.readouterr().out
    assert data_of((out / "report.html").read_text(encoding="utf-8"))["plans"][0]["time"] == plain.time.tolist()
    before = (out / "report.html").read_bytes()
    (tmp_path / "bad.npz").write_bytes(b"no plan")
    assert make_report.main([str(plan), str(tmp_path / "bad.npz"), "--out", str(out)]) == 2
    assert "bad.npz is not a plan" in capsys.readouterr().err
    assert (out / "report.html").read_bytes() == before
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("mine")
    assert make_report.main([str(plan), "--out", str(tmp_path / "mine")]) == 2
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["thesis.txt"]


def test_planning_needs_none_of_the_pages_libraries(tmp_path):
    code = (
        "import sys\n"
        "for name in ('k3d', 'jinja2', 'playwright', 'ipywidgets'): sys.modules[name] = None\n"
        "import ctr_nlp as ctr\n"
        "path = ctr.curve_from_formula(lambda u: (0.002 * u**2, 0.0, u), 0.0, 120.0)\n"
        "problem = ctr.Problem('p', ctr.table_i_robot(), ctr.growing(path, frames=2))\n"
        "plan = ctr.solve_per_frame(problem, 'joint', model='dominant', direction='forward')\n"
        "assert plan.complete\n"
        "plan.save('plan.npz')\n"
        "assert 'matplotlib' not in sys.modules, 'solving loads pictures'\n"
        "from ctr_nlp.view import figures\n"
        "figures.shapes(plan)\n"
        "from ctr_nlp.cli.commands import report\n"
        "sys.exit(report.main(['plan.npz']))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2, done.stderr
    assert "[report]" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["plan.npz"]
    assert Plan.load(tmp_path / "plan.npz").complete
