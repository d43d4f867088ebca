"""What the page says and shows of the robots that a plan was tried on."""

import html
import re

import numpy as np
import pytest
from browser import SOFTWARE, launcher, opened, pixels, share_of_hue
from matplotlib.colors import to_rgb
from near_fold import near_the_fold, plan_through

from ctr_nlp.plan import sample_text, summary_text
from ctr_nlp.view.report import page
from ctr_nlp.view.report.ghosts import (
    MAX_REPORT_GHOSTS,
    REPORT_FAILED_GHOST_COLOUR,
    REPORT_GHOST_SAMPLE_STRIDE,
    SAMPLED_ROBOTS_PART,
    ghosts,
)
from ctr_nlp.view.report.plots import SAMPLE_ERROR_PANEL_NAME as PANEL
from ctr_nlp.view.report.plots import panels


@pytest.fixture(scope="module")
def plan():
    return plan_through(near_the_fold()).with_samples(30, 4)


class Kept:
    """Stands for k3d, and keeps what it is asked to draw."""

    @staticmethod
    def lines(vertices, indices, **told):
        return {"vertices": vertices, "indices": indices} | told


def test_the_scene_holds_the_first_draws_as_they_were_tried(plan):
    (told,) = ghosts(Kept, plan)
    assert told["custom_data"] == {"part": SAMPLED_ROBOTS_PART}
    frame = plan.drawn.cloud_frames[-1]
    shapes = told["vertices"][str(frame - 1)].reshape(MAX_REPORT_GHOSTS, -1, 3)
    both = (
        np.arange(0, 101, REPORT_GHOST_SAMPLE_STRIDE * 4) // REPORT_GHOST_SAMPLE_STRIDE,
        np.arange(0, 101, REPORT_GHOST_SAMPLE_STRIDE * 4) // 4,
    )
    np.testing.assert_allclose(shapes[:, both[0]], plan.drawn.cloud[-1][:MAX_REPORT_GHOSTS, both[1]], atol=1e-4)
    lost = told["attribute"][str(frame - 1)].reshape(MAX_REPORT_GHOSTS, -1)
    np.testing.assert_array_equal(
        lost[:, 0] == 1, (plan.drawn.lost > 0)[:MAX_REPORT_GHOSTS] & (plan.drawn.lost <= frame)[:MAX_REPORT_GHOSTS]
    )
    first, second = told["indices"].T
    assert (first // shapes.shape[1] == second // shapes.shape[1]).all()
    assert ghosts(Kept, plan_through(near_the_fold())) == []


def test_the_page_tells_what_became_of_the_draws(plan):
    found, text = plan.drawn, html.unescape(page([plan]))
    for sentence in [plan.verdicts.holds.why, *sample_text.robustness_sentences(found)]:
        assert f"<p>{sentence}</p>" in text
    assert f"{len(found)} robots within the tolerances were sampled at random (seed {found.seed})" in text
    captions = [table.title for table in sample_text.tables(plan)]
    assert re.findall(r"<caption>(.*?)</caption>", text) == captions
    assert len(captions) == 3
    row = [f'<th scope="row">{found.costs[0].tolerance.replace("_", " ")} of tube {found.costs[0].tube}</th>']
    row.append(f"<td>{summary_text.format_cell(found.costs[0].growth)}</td>")
    assert "".join(row) in text
    means = [summary_text.format_cell(value) for value in found.errors]
    assert "".join(f"<td>{value}</td>" for value in means) in text


def test_sentences_name_the_worst_tolerance_and_where_draws_are_lost(plan):
    told = " ".join(sample_text.robustness_sentences(plan.drawn))
    most = plan.drawn.costs[0]
    assert f"The {most.tolerance.replace('_', ' ')} of tube {most.tube} costs most" in told
    for stretch in sample_text.find_loss_intervals(plan.drawn):
        assert f"{stretch.frames} ({stretch.draws} of them, {stretch.out} mm extended)" in told


def test_errors_of_draws_have_their_band_and_marks_where_draws_are_lost(plan):
    (panel,) = [panel for panel in panels(plan) if panel.name == PANEL]
    _, low, high = panel.band
    median = panel.lines[0].y
    assert ((low <= median) & (median <= high)).all()
    assert panel.marks[1].tolist() == [loss.frame for loss in plan.drawn.losses_by_frame]


@pytest.mark.parametrize("width", [1280, 390])
def test_drawn_robots_are_shown_until_they_are_switched_off(plan, tmp_path, width):
    file = tmp_path / "report.html"
    file.write_text(page([plan]), encoding="utf-8")
    with launcher() as launch, opened(launch(SOFTWARE), file, width) as view:
        view.wait_for_function("scenes.every((scene) => scene)")
        view.locator("#frame").fill(str(len(plan.time)))
        view.evaluate("document.getElementById('looks').open = true")
        shares = []
        for _ in range(2):
            view.wait_for_timeout(600)
            shares.append(
                share_of_hue(pixels(view.locator(".scene").screenshot()), to_rgb(REPORT_FAILED_GHOST_COLOUR), 0.01)
            )
            assert view.locator(".legend[data-of='sampled robots']").is_visible() == (len(shares) == 1)
            box = view.get_by_role("checkbox", name="sampled robots")
            box.focus()
            box.press("Space")
        assert shares[1] < 1e-5 < shares[0]
        view.get_by_role("link", name="holds on built robots").click()
        assert view.get_by_role("region", name="Robots within the tolerances").is_visible()
        assert view.evaluate("document.documentElement.scrollWidth") <= width


def test_plans_beside_one_that_was_tried_say_that_they_were_not(plan):
    text = page([plan, plan_through(near_the_fold())])
    assert text.count("no robots were simulated on this plan") == 1
    assert "Robots within" not in page([plan_through(near_the_fold())])
