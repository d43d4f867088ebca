"""Load a plan of ctr_nlp into 3D Slicer, and film it.

Written beside the plan's files by `ctr-nlp export PLAN.npz --to slicer`. In Slicer, open the Python console (View,
Python Console) and enter, with the path of this folder:

    import sys; sys.path.insert(0, r"FOLDER"); import load_in_slicer as plan
    browser = plan.load()                # the toolbar of sequences plays and scrubs the motion
    plan.film(browser, r"PICTURES")      # a picture a frame; with video="plan.mp4" also a film, which needs ffmpeg

or start Slicer with `--python-script FOLDER/load_in_slicer.py`, which loads. Load the scan itself as usual:
the plan is in its coordinates.

Not validated for use on patients.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import slicer
import vtk

NOT_FOR_PATIENTS = "Not validated for use on patients."
"""Printed, shown in the 3D view, and the description of everything that is loaded."""
HERE = Path(__file__).resolve().parent
KINDS = {"tubes": ".vtp", "robot": ".mrk.json", "target": ".mrk.json"}
"""What there is of every frame, and how the names of its files end."""
LINES = {"robot": (0.0, 0.45, 0.7), "target": (0.0, 0.0, 0.0)}
"""Colours of curves."""
LINE_MM = 0.6
"""How thick they are."""
COLOURS = "vtkMRMLColorTableNodeFileMediumChartColors.txt"
"""The colours of tubes, by their numbers."""
KEEP_OUT_COLOUR = (0.8, 0.47, 0.65)
"""Colour of what the robot keeps away from."""


def frames(folder: Path = HERE) -> list[tuple[str, str]]:
    """Time in s and number of every frame, as texts, from tubes.pvd."""
    listed = ElementTree.parse(folder / "tubes.pvd").iter("DataSet")
    return [(each.attrib["timestep"], Path(each.attrib["file"]).stem.partition("_")[2]) for each in listed]


def load(folder: Path = HERE) -> Any:
    """Load all frames as sequences over time, and the walls that there are; the sequence browser."""
    print(NOT_FOR_PATIENTS)
    browser = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLSequenceBrowserNode", "plan")
    sequences = [sequence_of(kind, suffix, folder) for kind, suffix in KINDS.items()]
    for sequence in sequences:
        browser.AddSynchronizedSequenceNode(sequence)
        browser.SetSaveChanges(sequence, False)
    slicer.modules.sequences.logic().UpdateProxyNodesFromSequences(browser)
    for sequence in sequences:
        show(browser.GetProxyNode(sequence))
    browser.SetSelectedItemNumber(browser.GetNumberOfItems() - 1)
    shown = [browser, *sequences, *(browser.GetProxyNode(sequence) for sequence in sequences)]
    for name in ("inscribed_tube.vtp", "wall.vtp", "keep_out.vtp"):
        if (folder / name).exists():
            shown.append(slicer.util.loadModel(str(folder / name)))
            shown[-1].GetDisplayNode().SetOpacity(0.2)
            if name == "keep_out.vtp":
                shown[-1].GetDisplayNode().SetColor(*KEEP_OUT_COLOUR)
    for node in shown:
        node.SetDescription(NOT_FOR_PATIENTS)
    annotate()
    return browser


def annotate() -> None:
    """Show in a corner of the 3D view that nothing here is validated; pictures and films show it too."""
    layout = slicer.app.layoutManager()
    if layout is None:  # Slicer runs without a window
        return
    view = layout.threeDWidget(0).threeDView()
    view.cornerAnnotation().SetText(vtk.vtkCornerAnnotation.LowerRight, NOT_FOR_PATIENTS)
    view.cornerAnnotation().GetTextProperty().SetColor(1.0, 1.0, 1.0)
    view.forceRender()


def sequence_of(kind: str, suffix: str, folder: Path) -> Any:
    """The sequence over time, in s, of what there is of every frame."""
    sequence = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLSequenceNode", kind)
    sequence.SetIndexName("time")
    sequence.SetIndexUnit("s")
    for time, number in frames(folder):
        file = str(folder / "frames" / f"{kind}_{number}{suffix}")
        node = slicer.util.loadModel(file) if kind == "tubes" else slicer.util.loadMarkups(file)
        sequence.SetDataNodeAtValue(node, time)
        slicer.mrmlScene.RemoveNode(node)
    return sequence


def show(node: Any) -> None:
    """Colour tubes by their numbers, and show of curves the line alone, in a colour and as thick as planned."""
    node.CreateDefaultDisplayNodes()
    display = node.GetDisplayNode()
    if node.IsA("vtkMRMLModelNode"):
        display.SetActiveScalar("tube", 1)  # of cells
        display.SetAndObserveColorNodeID(COLOURS)
        display.SetScalarVisibility(True)
        return
    display.SetSelectedColor(*LINES[node.GetName()])
    display.SetCurveLineSizeMode(display.UseLineDiameter)
    display.SetLineDiameter(LINE_MM)
    display.SetUseGlyphScale(False)
    display.SetGlyphSize(LINE_MM)
    display.SetPointLabelsVisibility(False)
    display.SetPropertiesLabelVisibility(False)


def film(browser: Any, folder: str, video: str | None = None) -> None:
    """Write a picture of the 3D view for every frame into a folder, and where video names a file, a film there.

    The film runs at the pace of the motion.
    """
    import ScreenCapture

    count, view = browser.GetNumberOfItems(), slicer.app.layoutManager().threeDWidget(0).threeDView()
    logic, names = ScreenCapture.ScreenCaptureLogic(), "frame_%04d.png"
    logic.captureSequence(view.mrmlViewNode(), browser, 0, count - 1, count, folder, names)
    if video is not None:
        times = [float(time) for time, _ in frames()]
        rate = (count - 1) / (times[-1] - times[0])
        logic.createVideo(rate, "-codec:v libx264 -pix_fmt yuv420p", folder, names, video)


if __name__ == "__main__":
    load()
