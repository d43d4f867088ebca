"""Ends of the names of files of anatomy, in lower case: help and messages list them without loading a reader."""

from __future__ import annotations

TABLE_SUFFIXES = (".csv", ".tsv", ".txt", ".fcsv", ".dat")
MARKUPS_SUFFIXES = (".mrk.json", ".json")
POLYLINE_SUFFIXES = (".vtp", ".vtk", ".vtu")
NIFTI_SUFFIXES = (".nii", ".nii.gz")
NRRD_SUFFIXES = (".nrrd", ".nhdr")

CENTRELINE_SUFFIXES = (*TABLE_SUFFIXES, *MARKUPS_SUFFIXES, *POLYLINE_SUFFIXES)
MASK_SUFFIXES = (*NIFTI_SUFFIXES, *NRRD_SUFFIXES)
ANATOMY_SUFFIXES = (*CENTRELINE_SUFFIXES, *MASK_SUFFIXES)
MESH_SUFFIXES = (".stl", ".vtp", ".vtk", ".ply", ".obj")
