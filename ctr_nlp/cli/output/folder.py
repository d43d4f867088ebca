"""Output folders. A run replaces what such runs wrote before, whole and at its end, and leaves all else alone.

A run writes into a hidden staging folder, and publishes its files in steps, as a journalling file system would:
the manifest says what will be done (`pending`); files move to their places; superseded ones are deleted; the
manifest says that it is done. Each step looks whether it has been done, so that the next run can complete the work
of one that was killed anywhere. Locks on folders keep two runs from publishing at the same time.
"""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from itertools import count
from pathlib import Path

from ctr_nlp.cli.output.file import check_writable
from ctr_nlp.cli.output.manifest import (
    MARK,
    STAGING,
    Manifest,
    WrittenFile,
    describe_file,
    read_manifest,
    standard_file_names,
)
from ctr_nlp.exceptions import OutputError
from ctr_nlp.support.folder_lock import lock_folder
from ctr_nlp.support.interrupt import ignored_interrupt

INTERRUPTED_FOLDER_NAME = "interrupted"
"""Folder within an output folder for the results of interrupted runs."""
NOMINAL_FOLDER_NAME = "nominal"
"""Folder within an output folder for the nominal robot's plan, while others are planned for."""
PUBLISH_LOCK_TIMEOUT_S = 10.0
"""Time for which a run waits for another one that publishes into the same folder, which takes milliseconds."""


def results_folder(out: Path, interrupted: bool) -> Path:
    """Return the folder for a run's files: `out`, or a folder of their own within it where the run was
    interrupted.
    """
    return out / INTERRUPTED_FOLDER_NAME if interrupted else out


def name_within(folder: Path, file: Path) -> str | None:
    """Return the name of `file` relative to `folder`; None where it lies outside."""
    place = file.parent.resolve() / file.name
    home = folder.resolve()
    return place.relative_to(home).as_posix() if place.is_relative_to(home) else None


def check_folder(folder: Path, kind: str, other: Path | None = None) -> None:
    """Raise OutputError unless a run of this kind can write into `folder`: it is new, empty or one of ours.

    kind: a key of manifest.STANDARD. other: another file that the run will write. None of the run's files within
    folder may be the user's. What a run that was killed has left in folder is completed or removed first.
    """
    target = folder.absolute()
    inner = None if other is None else name_within(folder, other)
    names = [*standard_file_names(kind, target), *([] if inner is None else [inner])]
    try:
        _check_no_file(target)
        if target.exists():
            # Locked while checking, too: files that another run is moving would look as if the user had changed
            # them.
            with lock_folder(target, PUBLISH_LOCK_TIMEOUT_S):
                _tidy(target)
                _check(target, names)
        check_writable(target / MARK)
    except OSError as error:
        raise OutputError(f"output folder {folder} cannot be written: {error}") from error


@contextmanager
def output_folder(folder: Path, kind: str) -> Iterator[Path]:
    """Yield a hidden folder; its files move to `folder` when the block ends well, else they vanish.

    kind: a key of manifest.STANDARD. Of what earlier runs wrote, files of the same kind that were not written
    again are deleted; all others stay. Two runs into one folder publish one after the other, each whole, as if the
    second had begun after the first. Raises OutputError, with the name of another folder that has the results
    where they could not be moved.
    """
    target = folder.absolute()
    fresh = not target.exists()
    try:
        with ExitStack() as held:
            staging = _staging(target, held)
            try:
                yield staging
                # Ctrl-C here would leave milliseconds of work to the next run.
                with ignored_interrupt():
                    _publish(staging, target, kind)
            finally:
                _discard(staging, target, fresh)
    except OSError as error:
        raise OutputError(f"output folder {folder} cannot be written: {error}") from error


def _check_no_file(folder: Path) -> None:
    """Raise OutputError where `folder` is a file or a link."""
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise OutputError(f"output folder {folder} is a file or a link; choose a folder with --out")


def _check(folder: Path, names: Sequence[str]) -> None:
    """Raise OutputError unless `folder` is new, empty or ours and nothing of the user's has one of `names`
    in it.
    """
    _check_no_file(folder)
    manifest = read_manifest(folder)
    if manifest is None and folder.exists() and any(map(_foreign, folder.iterdir())):
        raise OutputError(
            f"output folder {folder} is not empty and was not written by ctr-nlp; choose another with --out"
        )
    occupied = ((manifest or Manifest({})).find_conflict(folder, name) for name in names)
    if (users := next(filter(None, occupied), None)) is not None:
        raise OutputError(
            f"{users} is in the way: ctr-nlp did not write it, or it was changed since; move it, or choose "
            "another folder with --out"
        )


def _foreign(entry: Path) -> bool:
    """Tell whether an entry of a folder without a manifest was left by something else than an interrupted or
    killed run.
    """
    ours = entry.name in (INTERRUPTED_FOLDER_NAME, NOMINAL_FOLDER_NAME) and (entry / MARK).is_file()
    return not ours and STAGING.fullmatch(entry.name) is None


def _staging(target: Path, locks: ExitStack) -> Path:
    """Make a locked folder within target, or where that fails beside it; locks: release it at the end."""
    name = f"{MARK}-{secrets.token_hex(4)}"
    try:
        # Within target, so that moving a file is a rename in one file system, which is atomic.
        return _make_locked_folder(target / name, locks)
    except OSError:
        return _make_locked_folder(target.parent / name, locks)


def _make_locked_folder(staging: Path, locks: ExitStack) -> Path:
    """Make the folder `staging` and lock it until `locks` are released."""
    staging.parent.mkdir(parents=True, exist_ok=True)
    # _tidy holds this lock, too: without it, another run would remove the folder between its making and its
    # locking.
    with lock_folder(staging.parent, PUBLISH_LOCK_TIMEOUT_S):
        staging.mkdir()
        locks.enter_context(lock_folder(staging))
    return staging


def _publish(staging: Path, target: Path, kind: str) -> None:
    """Move files from staging to their places in target; those that cannot go there get a folder of their own.

    The manifest says beforehand what will be done, so that the next run completes it should this one be killed.
    """
    paths = [path for path in staging.rglob("*") if path.is_file()]
    new = {path.relative_to(staging).as_posix(): describe_file(kind, path) for path in sorted(paths)}
    try:
        for path in paths:
            with open(path, "rb+") as file:
                # On the disk before the manifest promises it, lest a crash of the machine leave empty files in
                # good places.
                os.fsync(file.fileno())
        # Checked again under the lock: the first check was before the run's work, perhaps hours ago.
        with lock_folder(target, PUBLISH_LOCK_TIMEOUT_S):
            _tidy(target)
            _check(target, list(new))
            if staging.parent != target:
                raise OutputError(f"output folder {target} could not be written")
            _write((read_manifest(target) or Manifest({})).with_pending(staging.name, kind, new), staging, target)
            if left := _finish(target):
                raise OutputError(f"{target / left[0]} was changed at the last moment")
    except (OSError, OutputError) as error:
        kept = _move_results_aside(staging, target, new)
        raise OutputError(f"{error}" if kept is None else f"{error}. The results are in {kept}") from error


def _write(manifest: Manifest, staging: Path, folder: Path) -> None:
    """Replace the manifest of `folder` in one step, from a temporary file in `staging`."""
    manifest.write(staging / MARK)
    os.replace(staging / MARK, folder / MARK)


def _tidy(folder: Path) -> None:
    """Complete what a killed run had begun to publish, and remove the staging folders of other killed runs.

    Raises OutputError where files have come in the way since, with the folder where the rest of its results is.
    """
    manifest = read_manifest(folder)
    if manifest is not None and manifest.pending is not None:
        new = manifest.pending.files
        staging = folder / manifest.pending.staging
        if left := _finish(folder):
            raise OutputError(
                f"{folder / left[0]} was changed after a run was killed that had begun to replace it. "
                f"The rest of that run's results is in {_move_results_aside(staging, folder, new)}"
            )
    for entry in folder.iterdir():
        if STAGING.fullmatch(entry.name) is not None and entry.is_dir() and not entry.is_symlink():
            # A living run holds the lock of its staging folder, and BlockingIOError skips it. Without locks nobody
            # can tell.
            with suppress(OSError), lock_folder(entry) as certain:
                if certain:
                    shutil.rmtree(entry)


def _finish(folder: Path) -> list[str]:
    """Do what is pending in the manifest and not done yet; return the names of files that could not be moved."""
    manifest = read_manifest(folder)
    if manifest is None or manifest.pending is None:
        return []
    staging = folder / manifest.pending.staging
    names = manifest.pending.files
    for name in names:
        if (staging / name).is_file() and manifest.find_conflict(folder, name) is None:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(staging / name, folder / name)
    # Superseded files go last: until all new ones are in place, nothing is lost.
    if all(one.is_at(folder / name) for name, one in names.items()):
        for name in manifest.pending.superseded:
            if manifest.owns_file(folder, name):
                _delete(folder, name)
    # The manifest is written here before it is moved; somebody may have removed the folder.
    staging.mkdir(exist_ok=True)
    _write(manifest.without_pending(folder), staging, folder)
    left = [name for name in names if (staging / name).is_file()]
    if not left:
        shutil.rmtree(staging)
    return left


def _delete(folder: Path, name: str) -> None:
    """Delete a file, and the folders within folder that it leaves empty."""
    (folder / name).unlink()
    with suppress(OSError):
        for parent in list(Path(name).parents)[:-1]:
            (folder / parent).rmdir()


def _move_results_aside(staging: Path, target: Path, new: Mapping[str, WrittenFile]) -> Path | None:
    """Make staging an output folder of its own, beside target or within it, and return it; None where that
    fails.
    """
    for stem in (f"{target}-kept", f"{target / 'kept'}"):
        place = next(place for n in count(1) if not os.path.lexists(place := Path(f"{stem}-{n}")))
        with suppress(OSError):
            Manifest({name: one for name, one in new.items() if (staging / name).is_file()}).write(staging / MARK)
            os.replace(staging, place)
            return place
    return None


def _discard(staging: Path, target: Path, fresh: bool) -> None:
    """Remove staging, unless the next run is to publish the rest of it, and target where it is fresh and empty."""
    with suppress(OSError, OutputError):
        manifest = read_manifest(target)
        if manifest is not None and manifest.pending is not None and manifest.pending.staging == staging.name:
            return
    shutil.rmtree(staging, ignore_errors=True)
    if fresh:
        with suppress(OSError):
            target.rmdir()
