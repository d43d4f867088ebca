"""A walk through the page in a real browser: every control by mouse, keys and touch; axe-core at three widths."""

import re

import numpy as np
import pytest
from browser import SOFTWARE, changed, launcher, opened, pixels, share_of_hue
from matplotlib.colors import to_rgb
from near_fold import near_the_fold, plan_through

from ctr_nlp.plan.metrics import by_frame
from ctr_nlp.view.figures.parts.palette import TUBE_COLOURS
from ctr_nlp.view.report import page

FRAMES, PLOTS = 12, 11
WIDTHS = (390, 768, 1440)

BOXES = """() => {
  const found = [];
  const add = (element, kind, box) => {
    if (box.width > 0 && box.height > 0) found.push({ element, kind, box });
  };
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let node = walker.nextNode(); node; node = walker.nextNode()) {
    const parent = node.parentElement;
    const apart = parent.closest("script, noscript, select, svg, .length, .why");
    if (!node.data.trim() || apart || !parent.checkVisibility()) continue;
    const range = document.createRange();
    range.selectNodeContents(node);
    for (const box of range.getClientRects()) add(parent, node.data.trim(), box);
  }
  for (const element of document.querySelectorAll("button, input, select, iframe, svg:not(.compass)")) {
    add(element, element.outerHTML.slice(0, 60), element.getBoundingClientRect());
  }
  const pairs = [];
  found.forEach((one, i) => found.slice(i + 1).forEach((other) => {
    const apart = Math.max(
      Math.max(one.box.left, other.box.left) - Math.min(one.box.right, other.box.right),
      Math.max(one.box.top, other.box.top) - Math.min(one.box.bottom, other.box.bottom));
    const within = one.element.contains(other.element) || other.element.contains(one.element);
    if (apart < -1 && !within) pairs.push(`${one.kind} | ${other.kind}`);
  }));
  return [found.length, pairs];
}"""
"""How many boxes of text and of controls there are, and which of them lie upon each other by more than a pixel.

The bar that tells lengths and the axes lie upon their scene on purpose.
"""
NAMES = """() => {
  const world = scenes[0].getWorld();
  return Object.keys(world.ObjectsById).map((id) => world.ObjectsListJson[id].name);
}"""
"""Names of the objects that the first scene draws."""


def tried_plan():
    """A plan on the dominant model with a wall that is touched and with draws, so that every control is there."""
    return plan_through(near_the_fold(frames=FRAMES), model="dominant", radius=6.0).with_samples(8, 4)


@pytest.fixture(scope="module")
def plan():
    return tried_plan()


@pytest.fixture(scope="module")
def files(plan, tmp_path_factory):
    """The page of one plan, and of two side by side, of which one was tried on no draws."""
    folder = tmp_path_factory.mktemp("walk")
    both = [plan, plan_through(near_the_fold(2.0, FRAMES // 2), model="dominant")]
    for name, plans in (("one", [plan]), ("both", both)):
        (folder / f"{name}.html").write_text(page(plans, [f"{name}/plan.npz"] * len(plans)), encoding="utf-8")
    return {name: folder / f"{name}.html" for name in ("one", "both")}


@pytest.fixture(scope="module")
def axe():
    module = pytest.importorskip("axe_playwright_python.sync_playwright", reason="axe-core is not installed")
    return module.Axe()


@pytest.fixture(scope="module")
def browser():
    with launcher() as launch:
        found = launch(SOFTWARE)
        yield found
        found.close()


def shown(view):
    """Wait until the scenes are drawn, and open the part of the page that has their controls."""
    view.set_default_timeout(120_000)
    view.wait_for_function("scenes.every((scene) => scene)")
    view.evaluate("document.getElementById('looks').open = true")
    settle(view)
    return view


@pytest.fixture(scope="module")
def wide(browser, files):
    with opened(browser, files["one"], 1440) as view:
        yield shown(view)


@pytest.fixture(autouse=True)
def _from_the_start(request):
    """Tests of the shared page find it as it opens."""
    if "wide" in request.fixturenames:
        view = request.getfixturevalue("wide")
        view.evaluate("stop(); look('side'); show(1 / slider.max); document.activeElement.blur(); scrollTo(0, 0)")
        settle(view)


def settle(view):
    """Until everything that was asked for is drawn."""
    view.evaluate("() => new Promise((done) => setTimeout(done, 500))")


def frame_of(view):
    return int(view.input_value("#frame"))


def scene_of(view):
    settle(view)
    return pixels(view.locator(".scene").first.screenshot())


def camera_of(view):
    return np.array(view.evaluate("cameraOf(scenes[0])"))


def told_values(view, plot):
    """What a plot's legend tells of its lines in the frame that is shown."""
    return view.locator(".plot").nth(plot).locator("output").all_inner_texts()


def number(text):
    return float(text.replace("−", "-"))


@pytest.mark.parametrize(
    ("name", "width"),
    [("one", WIDTHS[0]), ("both", 390), ("both", 1440)]
    + [
        pytest.param(*case, marks=pytest.mark.slow)
        for case in (*(("one", width) for width in WIDTHS[1:]), ("both", 768))
    ],
)
def test_nothing_overlaps_and_axe_finds_no_serious_fault(browser, files, axe, name, width):
    with opened(browser, files[name], width) as view:
        shown(view)
        assert view.evaluate("document.documentElement.scrollWidth") <= width
        count, pairs = view.evaluate(BOXES)
        assert count > 100
        assert pairs == []
        for frame in view.frames:
            found = axe.run(frame, options={"iframes": False})
            grave = [fault for fault in found.response["violations"] if fault["impact"] in ("serious", "critical")]
            assert grave == [], found.generate_report()
            if frame == view.main_frame:
                assert "color-contrast" in [rule["id"] for rule in found.response["passes"]]


def test_the_check_of_boxes_and_axe_find_what_is_wrong(wide, axe):
    """Two words upon each other, and a button without a name."""
    wide.evaluate(
        "document.body.insertAdjacentHTML('beforeend', '<div id=bad><button></button><p>first</p>"
        '<p style="margin-top:-2.4em">second</p></div>\')'
    )
    assert any("first | second" in pair for pair in wide.evaluate(BOXES)[1])
    assert "button-name" in [fault["id"] for fault in axe.run(wide, "#bad").response["violations"]]
    wide.evaluate("document.getElementById('bad').remove()")


def test_keys_play_step_and_jump(wide):
    for key, frame in (("ArrowRight", 2), ("ArrowRight", 3), ("ArrowLeft", 2), ("End", FRAMES), ("Home", 1)):
        wide.keyboard.press(key)
        assert frame_of(wide) == frame
    wide.keyboard.press("Space")
    wide.wait_for_function("playing && slider.value > 2")
    assert wide.locator("#play").get_attribute("aria-label") == "Pause"
    wide.keyboard.press("Space")
    assert wide.evaluate("playing") is None
    wide.locator("#play").focus()
    wide.keyboard.press("Space")
    assert wide.evaluate("playing") is not None
    wide.keyboard.press("End")
    assert (frame_of(wide), wide.evaluate("playing")) == (FRAMES, None)


def test_keys_that_a_control_needs_are_its_own(wide):
    wide.locator("#colouring").focus()
    wide.keyboard.press("ArrowDown")
    assert (frame_of(wide), wide.input_value("#colouring")) == (1, "error")
    wide.keyboard.press("Home")
    assert wide.input_value("#colouring") == "tube"
    wide.locator("#frame").focus()
    wide.keyboard.press("ArrowRight")
    assert frame_of(wide) == 2
    wide.locator("#loop").focus()
    wide.keyboard.press("Space")
    assert wide.locator("#loop").is_checked()
    assert wide.evaluate("playing") is None
    wide.locator("#loop").uncheck()


def test_keys_work_in_the_scene_too_and_turn_it(wide):
    box = wide.locator(".scene").bounding_box()
    wide.mouse.click(box["x"] + 30, box["y"] + 30)
    wide.keyboard.press("ArrowRight")
    assert frame_of(wide) == 2
    before = camera_of(wide)
    wide.keyboard.press("Shift+ArrowRight")
    settle(wide)
    after = camera_of(wide)
    away, was = after[:3] - after[3:6], before[:3] - before[3:6]
    assert np.linalg.norm(away) == pytest.approx(np.linalg.norm(was))
    cosine = away @ was / (away @ away)
    tilt = was @ before[6:] / np.linalg.norm(was)
    assert cosine == pytest.approx(tilt**2 + (1 - tilt**2) * np.cos(np.radians(10)), abs=1e-6)
    assert frame_of(wide) == 2
    assert wide.locator("[data-camera=free]").get_attribute("aria-pressed") == "true"


def test_buttons_step_and_every_control_shows_its_focus(wide):
    wide.get_by_role("button", name="Next frame").click()
    wide.get_by_role("button", name="Next frame").click()
    wide.get_by_role("button", name="Previous frame").click()
    assert frame_of(wide) == 2
    seen = []
    for first, count in ((".chip", 16), ("#frame", 6)):  # until the scene, and from it until the plots
        wide.locator(first).first.focus()
        for _ in range(count):
            wide.keyboard.press("Tab")
            look = "getComputedStyle(document.activeElement)"
            assert wide.evaluate(f"{look}.outlineStyle") == "solid"
            assert float(wide.evaluate(f"{look}.outlineWidth").removesuffix("px")) >= 2
            seen.append(wide.evaluate("document.activeElement.outerHTML"))
    assert len(set(seen)) == 22
    assert 'id="print"' in seen[-1]


def test_chips_tell_why_on_focus_hover_and_touch(wide, plan):
    chips = wide.locator(".chip")
    assert chips.count() == len(plan.verdicts)
    for k, verdict in enumerate(plan.verdicts):
        text = chips.nth(k).inner_text()
        assert verdict.matter in text
        assert verdict.word in text
        why = wide.locator(".why").nth(k)
        assert why.is_hidden()
        chips.nth(k).focus()
        assert why.inner_text() == verdict.why
        wide.keyboard.press("Escape")
        assert why.is_hidden()
    chips.nth(2).hover()
    assert wide.locator(".why").nth(2).is_visible()
    wide.mouse.move(5, 800)
    grounds = {
        verdict.word: chips.nth(k).evaluate("(chip) => getComputedStyle(chip).backgroundColor")
        for k, verdict in enumerate(plan.verdicts)
    }
    assert len(set(grounds.values())) == len(grounds) == 3


def test_the_way_to_go_and_places_are_those_of_the_plan(wide, plan):
    for frame in (3, FRAMES):
        wide.evaluate(f"show({frame} / slider.max)")
        tip, end = plan.shape[frame - 1, -1], plan.target[-1, -1]
        angle = np.degrees(np.arccos(plan.tip_direction[frame - 1] @ plan.target_direction[-1]))
        text = wide.locator(".arrival").inner_text()
        assert text == f"tip {np.linalg.norm(tip - end):.1f} mm, {angle:.0f}° to go"
        told = wide.locator(".places").inner_text().replace("−", "-")
        numbers = [float(x) for x in re.findall(r"-?\d+\.\d+", told)]
        np.testing.assert_allclose(numbers[:3], tip, atol=0.06)
        worst = plan.clearance[frame - 1].argmin()
        assert numbers[3] == pytest.approx(abs(plan.clearance[frame - 1, worst]), abs=0.006)
        np.testing.assert_allclose(numbers[4:], plan.shape[frame - 1, worst], atol=0.06)
        assert "base frame" in told
    assert "frame by frame is not kept" in wide.locator(".samples").inner_text()


def test_speed_and_loop_say_how_it_is_played(wide, plan):
    """A clock that the test winds: playing for 1 s at 4 × moves by 4 s of the plan."""
    wide.evaluate(
        "window.kept = [requestAnimationFrame, performance.now]; window.waiting = null;"
        "window.requestAnimationFrame = (go) => { waiting = go; return 1; }; performance.now = () => 0;"
    )
    for speed in ("0.5", "4"):
        wide.evaluate("seek(1 / slider.max)")
        wide.select_option("#speed", speed)
        moved = wide.evaluate(
            "(() => { const before = shown; play(); waiting(1000); stop(); return shown - before; })()"
        )
        assert moved == pytest.approx(float(speed) / plan.time[-1])
    for loops in (True, False):
        wide.locator("#loop").set_checked(loops)
        wide.evaluate("seek(0.9); play(); waiting(1000)")
        assert (wide.evaluate("playing") is not None) == loops
        assert wide.evaluate("shown") == pytest.approx((0.9 + 4 / plan.time[-1]) % 1 if loops else 1)
    wide.evaluate("stop(); [window.requestAnimationFrame, performance.now] = kept")
    wide.select_option("#speed", "1")


def test_cameras_look_from_the_side_the_top_and_the_tip(wide, plan):
    def pressed():
        return wide.locator("[data-camera][aria-pressed=true]").all_inner_texts()

    wide.keyboard.press("End")
    views = []
    for name, label in (("side", "Side"), ("top", "Top")):
        wide.get_by_role("button", name=label).click()
        assert pressed() == [label]
        views.append(scene_of(wide))
        found, wanted = camera_of(wide), np.array(wide.evaluate(f"report.cameras.{name}"))
        np.testing.assert_allclose(found[3:], wanted[3:], atol=1e-9)
        away, there = found[:3] - found[3:6], wanted[:3] - wanted[3:6]
        np.testing.assert_allclose(away / np.linalg.norm(away), there / np.linalg.norm(there), atol=1e-9)
    assert changed(*views) > 0.005
    wide.get_by_role("button", name="Tip's eye").click()
    for key, j in (("End", -1), ("ArrowLeft", -2)):
        wide.keyboard.press(key)
        settle(wide)
        found, tip, along = camera_of(wide), plan.shape[j, -1], plan.tip_direction[j]
        assert np.linalg.norm(found[:3] - tip) < 2.0
        sight = found[3:6] - found[:3]
        np.testing.assert_allclose(sight / np.linalg.norm(sight), along, atol=1e-3)
        assert abs(found[6:] @ along) < 1e-3
    assert wide.locator(".length").is_hidden()
    wide.get_by_role("button", name="Free").click()
    kept = camera_of(wide)
    wide.keyboard.press("Home")
    settle(wide)
    np.testing.assert_array_equal(camera_of(wide), kept)
    wide.get_by_role("button", name="Side").click()
    settle(wide)
    assert wide.locator(".length").is_visible()
    box = wide.locator(".scene").bounding_box()
    wide.mouse.move(box["x"] + 200, box["y"] + 200)
    wide.mouse.down()
    wide.mouse.move(box["x"] + 300, box["y"] + 200, steps=3)
    wide.mouse.up()
    assert pressed() == ["Free"]


def test_the_bar_is_as_long_as_it_says(wide):
    """Beside two points so far apart across the line of sight, by the projection of k3d's own camera."""
    long = float(
        wide.evaluate("document.querySelector('.length').style.getPropertyValue('--long')").removesuffix("px")
    )
    told = float(wide.locator(".length").inner_text().removesuffix(" mm"))
    projected = wide.evaluate(
        """(apart) => {
          const world = scenes[0].getWorld();
          const middle = world.controls.target.clone();
          const across = middle.clone().set(1, 0, 0).applyQuaternion(world.camera.quaternion);
          world.camera.updateMatrixWorld();
          const ends = [middle.clone(), middle.clone().addScaledVector(across, apart)];
          const [a, b] = ends.map((end) => end.project(world.camera).x);
          return (Math.abs(b - a) / 2) * world.targetDOMNode.offsetWidth;
        }""",
        told,
    )
    assert long == pytest.approx(projected, rel=0.01)
    assert 30 < long <= 90


def test_parts_are_switched_on_and_off(wide):
    wide.keyboard.press("End")
    before = scene_of(wide)
    names = {part: part for part in ("target", "target's end", "sampled robots")}
    names |= {"robot": "tube 1", "wall": "lumen"}
    for part, name in names.items():
        assert name in wide.evaluate(NAMES)
        wide.get_by_label(part, exact=True).uncheck()
        settle(wide)
        assert name not in wide.evaluate(NAMES)
        without = scene_of(wide)
        assert changed(without, before) > 1e-4, part
        if part == "robot":
            assert share_of_hue(without, to_rgb(TUBE_COLOURS[0])) < 0.2 * share_of_hue(
                before, to_rgb(TUBE_COLOURS[0])
            )
        wide.get_by_label(part, exact=True).check()
        settle(wide)
        assert changed(scene_of(wide), before) < 1e-3, part
    wide.get_by_label("see-through").check()
    assert changed(scene_of(wide), before) > 1e-3
    wide.get_by_label("see-through").uncheck()


def test_a_click_on_any_plot_goes_to_its_frame_and_all_plots_follow(wide, plan):
    plots = wide.locator(".axes")
    assert plots.count() == PLOTS
    errors = by_frame(plan)["e2"]
    for k in range(plots.count()):
        frame = 2 + k
        plots.nth(k).scroll_into_view_if_needed()
        box = plots.nth(k).locator("svg").bounding_box()
        part = plan.time[frame - 1] / wide.evaluate(f"report.plans[0].plots[{k}].end")
        wide.mouse.click(box["x"] + part * box["width"], box["y"] + box["height"] / 2)
        assert frame_of(wide) == frame
        assert number(told_values(wide, 2)[0]) == pytest.approx(errors[frame - 1], rel=5e-3)
        assert f"frame {frame} of {FRAMES}" in wide.locator(".readout").inner_text()
        lefts = {wide.locator(".cursor").nth(p).evaluate("(cursor) => cursor.style.left") for p in range(PLOTS)}
        assert len(lefts) == 1
        assert float(lefts.pop().removesuffix("%")) == pytest.approx(100 * part)


def test_the_page_opens_at_the_last_frame_and_plays_from_the_first(browser, files):
    """In the first one there is little to be seen of a robot."""
    with opened(browser, files["one"], 768) as view:
        shown(view)
        assert frame_of(view) == FRAMES
        assert view.locator("#moment").inner_text() == f"frame {FRAMES} of {FRAMES}"
        view.locator("#play").click()
        view.wait_for_function(f"playing && slider.value < {FRAMES // 2}")


def test_on_a_phone_what_is_compared_is_named_above_its_numbers(browser, files):
    with opened(browser, files["both"], 390, 844) as view:
        view.set_default_timeout(120_000)
        width = view.locator(".compared table").bounding_box()["width"]
        for row in view.locator(".compared tbody tr").all():
            name, *cells = [cell.bounding_box() for cell in row.locator("th, td").all()]
            assert name["width"] > 0.9 * width
            assert name["height"] < 60
            assert all(cell["y"] >= name["y"] + name["height"] - 1 for cell in cells)
            assert all(cell["width"] > 0.1 * width for cell in cells)


def test_touch_plays_taps_and_scrubs(browser, files, plan):
    with opened(browser, files["one"], 390, 844, has_touch=True, is_mobile=True, device_scale_factor=2) as view:
        view.set_default_timeout(120_000)
        view.wait_for_function("scenes.every((scene) => scene)")
        assert not view.locator("#looks").evaluate("(looks) => looks.open")
        view.get_by_text("View", exact=True).tap()
        view.get_by_role("button", name="Top").tap()
        settle(view)
        np.testing.assert_allclose(camera_of(view)[6:], [0, 1, 0], atol=1e-9)
        view.get_by_role("button", name="Previous frame").tap()
        assert frame_of(view) == FRAMES - 1
        view.evaluate("show(2 / slider.max)")
        view.locator("#play").tap()
        view.wait_for_function("playing && slider.value > 2")
        view.locator("#play").tap()
        assert view.evaluate("playing") is None
        axes = view.locator(".axes").first
        axes.scroll_into_view_if_needed()
        box = axes.locator("svg").bounding_box()
        view.touchscreen.tap(box["x"] + 0.5 * box["width"], box["y"] + 60)
        assert FRAMES // 2 <= frame_of(view) <= FRAMES // 2 + 1
        touch = view.context.new_cdp_session(view)
        for kind, part in (("touchStart", 0.2), ("touchMove", 0.4), ("touchMove", 0.8), ("touchEnd", None)):
            points = [] if part is None else [{"x": box["x"] + part * box["width"], "y": box["y"] + 60}]
            touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
        settle(view)
        assert frame_of(view) == pytest.approx(0.8 * (plan.time[-1] + plan.dt / 2) / plan.dt, abs=0.6)
        sizes = view.evaluate(
            "[...document.querySelectorAll('button, select, summary')]"
            ".filter((control) => control.checkVisibility())"
            ".map((control) => control.getBoundingClientRect().height)"
        )
        assert min(sizes) >= 24


def test_the_print_shows_chosen_frames_without_controls(wide, plan):
    wide.keyboard.press("End")
    settle(wide)
    wide.evaluate("drawPrints()")
    assert frame_of(wide) == FRAMES
    wide.emulate_media(media="print")
    settle(wide)
    for control in ("#play", "#frame", "[data-camera=side]", "iframe"):
        assert wide.locator(control).first.is_hidden()
    captions = wide.locator(".prints figcaption").all_inner_texts()
    worst = int(by_frame(plan)["e2"].argmax()) + 1
    frames = {"first frame": 1, "middle frame": FRAMES // 2 + 1, "largest error e2": worst, "last frame": FRAMES}
    assert [text.split(":")[0] for text in captions] == [
        f"{name}, {frame} of {FRAMES}" for name, frame in frames.items()
    ]
    shots = [pixels(picture.screenshot()) for picture in wide.locator(".prints img").all()]
    assert share_of_hue(shots[-1], to_rgb(TUBE_COLOURS[0])) > 3e-4
    assert changed(shots[0], shots[-1]) > 1e-3
    assert min(shot.shape[1] for shot in shots) > 400
    wide.emulate_media(media="screen")


def test_verdicts_come_first_in_plain_words_and_two_plans_stand_side_by_side(browser, files, plan):
    with opened(browser, files["both"], 1440) as view:
        shown(view)
        lead = view.locator(".lead").first
        failed = ", ".join(plan.verdicts.failed_names)
        assert lead.inner_text().startswith(f"This plan fails {len(plan.verdicts.failed_names)} of 7 checks")
        assert failed in lead.inner_text()
        tops = [view.locator(part).first.bounding_box()["y"] for part in (".lead", ".chips", ".view", ".verdicts")]
        assert tops == sorted(tops)
        rows = view.locator(".compared tbody tr")
        cells = {
            row[0]: row[1:]
            for row in (rows.nth(k).locator("th, td").all_inner_texts() for k in range(rows.count()))
        }
        assert cells["within the wall"][0].startswith("no, ")
        assert cells["within the wall"][1] == "NOT CHECKED"
        assert number(cells["e3, RMS over frames of e2"][0]) == pytest.approx(
            np.sqrt((by_frame(plan)["e2"] ** 2).mean()), rel=5e-3
        )
        boxes = [view.locator(".plan").nth(k).bounding_box() for k in (0, 1)]
        assert boxes[0]["x"] + boxes[0]["width"] <= boxes[1]["x"]
