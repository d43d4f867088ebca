"""Tables of measurements as programs write them: read alike, or refused with the name of what is wrong."""

import itertools

import numpy as np
import pytest
from sensed import TWO

from ctr_nlp.exceptions import MeasurementError
from ctr_nlp.identify.calibration.reading import read_measurements

HEADER = ("alpha_1", "alpha_2", "beta_1", "beta_2", "tip_x", "tip_y", "tip_z")
ROWS = ((0.1, -0.2, 30, 80, 1.5, 2.5, 80), (0.5, 0.25, 20, 60, 0.5, 1.25, 59))


def text(header=HEADER, rows=ROWS, separator=",", decimal="."):
    lines = [header, *([str(value).replace(".", decimal) for value in row] for row in rows)]
    return "\n".join(separator.join(line) for line in lines) + "\n"


def read(tmp_path, content):
    path = tmp_path / "m.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_measurements(path, TWO)


@pytest.mark.parametrize(
    "content",
    [
        text(),
        text(separator=";", decimal=","),
        text(separator=";"),
        text(separator="\t"),
        text(separator=" "),
        text().replace("\n", "\r\n"),
        text().replace("\n", ",,\n"),
        text().encode("utf-16"),
        b"\xef\xbb\xbf" + text().encode(),
        b"# M\xfcller, 20 \xb0C\n" + text().encode(),
        "# poses\n% of today\n// in the lab\n" + text(),
        "# of today\n# " + text(),
        text(tuple(f'"{name}"' for name in HEADER)),
        text(("Alpha 1", "alpha2", "BETA-1 [mm]", "beta_2_mm", "tip x (mm)", "tip_y_mm", "tip.z")),
    ],
)
def test_usual_tables_are_read_alike(tmp_path, content):
    found = read(tmp_path, content)
    np.testing.assert_array_equal(found.q[:, :4], np.array(ROWS)[:, :4])
    np.testing.assert_array_equal(found.tip, np.array(ROWS)[:, 4:])
    assert (np.diff(found.line) == 1).all()


@pytest.mark.parametrize(
    ("lengths", "angles"), list(itertools.product((("m", 1000), ("cm", 10), ("in", 25.4)), ("deg", "rad")))
)
def test_units_in_names_are_understood(tmp_path, lengths, angles):
    unit, factor = lengths
    names = (*(f"{name}_{angles}" for name in HEADER[:2]), *(f"{name}_{unit}" for name in HEADER[2:]))
    turn = np.pi / 180 if angles == "deg" else 1.0
    rows = np.array(ROWS) / ([turn] * 2 + [factor] * 5)
    found = read(tmp_path, text(names, rows.tolist()))
    np.testing.assert_allclose(found.q[:, :4], np.array(ROWS)[:, :4])
    np.testing.assert_allclose(found.tip, np.array(ROWS)[:, 4:])


def test_points_and_times_have_units_too(tmp_path):
    names = (*HEADER, "p1_x_cm", "p1_y_cm", "p1_z_cm", "p1_s_cm", "time_ms")
    rows = [(*row, 0.1, 0.2, 3.0, 4.0, 1000 * k) for k, row in enumerate(ROWS)]
    found = read(tmp_path, text(names, rows))
    np.testing.assert_allclose(found.points[:, 0], [[1, 2, 30]] * 2)
    np.testing.assert_allclose(found.sigma[:, 0], [40 / 80, 40 / 60])
    np.testing.assert_allclose(found.time, [0, 1])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (text((*HEADER[:6], "tip_z_km")), "a column 'tip_z_km', which is unknown"),
        (text((*HEADER[:6], "tip_z_deg")), "a column 'tip_z_deg', which is unknown"),
        (text((*HEADER[:4], "x", "y", "z")), "a column 'x', which is unknown"),
        (text((*HEADER[:6], "temperature")), "a column 'temperature'"),
        (text((*HEADER[:6], "tip_x_mm")), "the column 'tip_x' twice"),
        (text(("", *HEADER), [(0, *ROWS[0]), (1, *ROWS[1])]), r"column 1 of .* has no name.*index=False"),
        (text((*HEADER, ""), [(*ROWS[0], 7), (*ROWS[1], 8)]), "column 8 of .* has no name"),
        (text(("alpha_1", "alpha_3", *HEADER[2:])), "'alpha_3', which is unknown, and no column alpha_2"),
        (text() + "1,2\n", "line 4 of .* has 2 cells; the first line names 7"),
        (text().encode()[:-9], "line 3 of .* has 5 cells"),
        (b"\x00\x01\x02", "cannot be read: it is no text"),
        (b"", "hold no rows"),
        (text(rows=[(*row[:2], row[3], row[2], *row[4:]) for row in ROWS]), "the columns beta_1 and beta_2 were"),
        (
            text(rows=[(row[1], row[0], row[3], row[2], *row[4:]) for row in ROWS]),
            "if tubes were numbered from the innermost one",
        ),
        (text(rows=[(*row[2:4], *row[:2], *row[4:]) for row in ROWS]), "alpha and beta were exchanged|must lie"),
        (text(rows=[(100, 200, *row[2:]) for row in ROWS]), "if angles were in degrees"),
        (text(rows=[(*row[:2], row[2] / 1000, row[3] / 1000, *row[4:]) for row in ROWS]), "are extensions in m?"),
        (
            text(rows=[(*row[:2], *(value / 1000 for value in row[2:])) for row in ROWS]),
            "are extensions and measured points in m?",
        ),
    ],
)
def test_what_is_not_certain_is_refused_by_name(tmp_path, content, message):
    with pytest.raises(MeasurementError, match=message) as raised:
        read(tmp_path, content)
    assert "\n" not in str(raised.value)
