"""Folders that one process at a time may write into."""

import shutil

from ctr_nlp.support import folder_lock
from ctr_nlp.support.folder_lock import lock_named_folder, remove_abandoned


def test_a_folder_is_free_again_although_an_orphan_writes_into_it_while_it_is_removed(tmp_path, monkeypatch):
    """As a compiler does whose parent was killed."""
    lock_named_folder(tmp_path / "building-1").release()
    real_rmtree, attempts = shutil.rmtree, []

    def remove_while_an_orphan_writes(folder):
        attempts.append(folder)
        assert not (tmp_path / "building-1").exists()  # another process may claim the name already
        if len(attempts) == 1:
            raise OSError("Directory not empty")
        real_rmtree(folder)

    monkeypatch.setattr(folder_lock.shutil, "rmtree", remove_while_an_orphan_writes)
    remove_abandoned(tmp_path, "building-*", 0.0)
    assert len(attempts) == 2
    assert not list(tmp_path.iterdir())
    claim = lock_named_folder(tmp_path / "building-1")
    assert claim is not None
    claim.release()
