"""The cache of compiled code: with and without compilers and folders, after damage, and from several processes."""

import ctypes
import errno
import hashlib
import itertools
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import platformdirs.macos
import platformdirs.unix
import pytest
from frames import alone

from ctr_nlp import table_i_robot
from ctr_nlp.codegen import cache
from ctr_nlp.exceptions import OptionError
from ctr_nlp.solvers import default_chain_solver
from ctr_nlp.solvers.compiled_functions import compile_functions, fastest_functions
from ctr_nlp.support import folder_lock
from ctr_nlp.support.folder_lock import lock_folder

OPTED_OUT = "CTR_NLP_COMPILE is 0"
BUILD = """\
import ctypes, sys
from ctr_nlp.solvers import cache
path = cache.library(sys.argv[1], lambda: sys.argv[2])
print(path, ctypes.CDLL(str(path)).answer())
"""
"""A process that makes a library of a key and code, and uses it."""

REAL = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), "no compiler")
"""The path of a compiler that works."""

numbers = itertools.count()


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    """A new cache folder, which does not exist yet; what was made, said and is known of compilers is forgotten."""
    for variable in ("CTR_NLP_COMPILE", "CC"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("CTR_NLP_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(cache, "_made", {})
    forget()
    yield tmp_path / "cache"
    forget()


@pytest.fixture
def tools(tmp_path, monkeypatch):
    """A folder that comes first where programs are sought, and nothing in it yet."""
    made = tmp_path / "tools"
    made.mkdir()
    monkeypatch.setenv("PATH", f"{made}{os.pathsep}{os.environ['PATH']}")
    return made


def forget():
    cache.compiler.cache_clear()
    cache.warn_once.cache_clear()


def program(folder, text, name="cc"):
    """A shell script under a compiler's name."""
    path = folder / name
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    forget()
    return path


def only(folder, monkeypatch):
    """Let programs be sought in a folder alone."""
    monkeypatch.setenv("PATH", str(folder))
    forget()


def code(number):
    return f"int answer(void) {{ return {number}; }}\n"


def made(key, number):
    return cache.library(key, lambda: code(number))


def kept(key, number):
    """The library of a key in the cache, as processes find it that did not make it."""
    made(key, number)
    cache._made.clear()
    return cache.library(key, never)


def never():
    raise AssertionError("compiled although the library was there")


def answer(path, folder):
    """What a library says; loaded from a copy, as loaders know a file that was replaced by its old path."""
    return ctypes.CDLL(str(shutil.copy(path, folder / f"copy-{next(numbers)}.so"))).answer()


def said(caplog):
    return [(record.levelname, record.getMessage()) for record in caplog.records if record.name == "ctr_nlp"]


def process(*arguments):
    """A process of its own group, whose output can be read."""
    return subprocess.Popen(
        [sys.executable, "-c", BUILD, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def answered(running):
    """Path and number that a process printed."""
    out, err = running.communicate(timeout=120)
    assert running.returncode == 0, err
    path, number = out.split()
    return Path(path), int(number)


def await_file(path, running):
    while not path.exists():
        assert running.poll() is None, running.communicate()
        time.sleep(0.02)


def assert_whole(path):
    digest = hashlib.sha256(path.parent.name.encode() + path.read_bytes()).hexdigest()
    assert path.with_name("sha256").read_text() == digest
    assert {each.name for each in path.parent.iterdir()} == {"code.c", "library.so", "sha256"}


# Compilers that are missing or fail


def test_without_a_compiler_the_error_and_one_warning_name_what_to_install(place, tools, monkeypatch, caplog):
    only(tools, monkeypatch)
    for _ in range(3):
        assert "install gcc or clang" in cache.unavailable_reason()
    with pytest.raises(OptionError, match=r"no C compiler was found; install gcc or clang"):
        cache.library("one", never)
    ((level, message),) = said(caplog)
    assert level == "WARNING"
    assert "install gcc or clang" in message
    assert not place.exists()


def test_without_a_compiler_problems_are_solved_interpreted(tools, monkeypatch):
    only(tools, monkeypatch)
    nlp = alone(table_i_robot())
    assert default_chain_solver() == "ipopt"
    assert fastest_functions(nlp)() is nlp.functions
    with pytest.raises(OptionError, match="install gcc or clang"):
        compile_functions(nlp)


def test_compiling_that_is_switched_off_is_not_warned_of(place, monkeypatch, caplog):
    monkeypatch.setenv("CTR_NLP_COMPILE", "0")
    nlp = alone(table_i_robot())
    assert cache.unavailable_reason() == OPTED_OUT
    assert default_chain_solver() == "ipopt"
    assert fastest_functions(nlp)() is nlp.functions
    with pytest.raises(OptionError, match=OPTED_OUT):
        cache.library("one", never)
    assert said(caplog) == []
    assert not place.exists()


@pytest.mark.parametrize("value", ["1", ""])
def test_other_values_of_the_switch_compile(value, monkeypatch, tmp_path):
    monkeypatch.setenv("CTR_NLP_COMPILE", value)
    assert cache.unavailable_reason() is None
    assert answer(made("one", 1), tmp_path) == 1


def test_where_a_compiler_works_nothing_is_said(caplog):
    assert cache.unavailable_reason() is None
    assert default_chain_solver() == "banded"
    assert said(caplog) == []


def test_a_compiler_that_always_fails_is_none(tools, monkeypatch, caplog):
    program(tools, "exit 1")
    only(tools, monkeypatch)
    assert cache.compiler() is None
    assert "install gcc or clang" in cache.unavailable_reason()
    assert len(said(caplog)) == 1


def test_a_compiler_that_always_fails_is_passed_over_for_the_next(tools, tmp_path):
    program(tools, "exit 1")
    program(tools, f'exec {REAL} "$@"', "gcc")
    assert shutil.which(cache.compiler().command[0]) == str(tools / "gcc")
    assert answer(made("one", 1), tmp_path) == 1


def test_the_compiler_of_cc_may_have_arguments(tmp_path, monkeypatch):
    """Which have libraries of their own."""
    paths = {}
    for arguments in ("", " -O1", ' -D"A B"', ""):
        monkeypatch.setenv("CC", REAL + arguments)
        forget()
        path = kept("one", 1)
        assert cache.compiler().command[0] == REAL
        assert paths.setdefault(arguments, path) == path
        assert answer(path, tmp_path) == 1
    assert len(set(paths.values())) == 3


def test_arguments_of_cc_reach_the_compiler(tmp_path, monkeypatch):
    monkeypatch.setenv("CC", f"{REAL} -DNUMBER=5")
    assert answer(cache.library("one", lambda: code("NUMBER")), tmp_path) == 5


@pytest.mark.parametrize("value", [" ", "no-such-compiler -O1", "/"])
def test_what_is_no_compiler_in_cc_is_passed_over(value, tmp_path, monkeypatch):
    monkeypatch.setenv("CC", value)
    assert cache.unavailable_reason() is None
    assert answer(made("one", 1), tmp_path) == 1


def test_a_quotation_in_cc_without_an_end_is_passed_over(tmp_path, monkeypatch):
    monkeypatch.setenv("CC", 'cc "-O1')
    assert cache.unavailable_reason() is None
    assert answer(made("one", 1), tmp_path) == 1


def test_a_compiler_that_cannot_link_is_said_once_in_its_own_words(place, tools, monkeypatch, caplog):
    program(tools, 'for a in "$@"; do [ "$a" = -E ] && exit 0; done; echo "ld: cannot find it" >&2; exit 1')
    only(tools, monkeypatch)
    for _ in range(3):
        assert "ld: cannot find it" in cache.unavailable_reason()
    with pytest.raises(OptionError, match="ld: cannot find it"):
        made("one", 1)
    ((level, message),) = said(caplog)
    assert level == "WARNING"
    assert "ld: cannot find it" in message
    assert not place.exists()
    assert default_chain_solver() == "ipopt"


@pytest.mark.parametrize("refused", ["-march=native", "-lmvec", cache.FAST_COMPILE_FLAGS[0]])
def test_what_a_compiler_does_not_know_is_left_out(refused, tools, tmp_path):
    program(tools, f'case " $* " in *" {refused} "*) exit 1;; esac\nexec {REAL} "$@"')
    assert shutil.which(cache.compiler().command[0]) == str(tools / "cc")
    assert ("-march=native" in cache.compiler().command) == (refused != "-march=native")
    assert (cache.FAST_COMPILE_FLAGS[0] in cache.compiler().command) == (refused == "-lmvec")
    assert answer(made("one", 1), tmp_path) == 1


@pytest.mark.parametrize("start", [b"\0", b"#!/nowhere/sh\n"], ids=["binary", "script"])
def test_a_compiler_that_cannot_be_started_is_none(start, tools, monkeypatch):
    program(tools, "").write_bytes(start)
    only(tools, monkeypatch)
    assert "install gcc or clang" in cache.unavailable_reason()


def test_a_compiler_that_does_not_speak_utf_8_is_none(tools, monkeypatch):
    program(tools, r"printf '\377' >&2; exit 1")
    only(tools, monkeypatch)
    assert "install gcc or clang" in cache.unavailable_reason()


def test_code_that_does_not_compile_raises_with_the_compilers_message_and_leaves_nothing(place):
    with pytest.raises(OptionError, match="undeclared_name"):
        cache.library("bad", lambda: "int answer(void) { return undeclared_name; }\n")
    assert not place.exists()


def test_code_that_cannot_be_written_leaves_nothing(place):
    def fails():
        raise NotImplementedError("no code for this")

    with pytest.raises(NotImplementedError, match="no code for this"):
        cache.library("bad", fails)
    assert not place.exists()


def test_a_full_disk_is_an_error_of_its_own_kind(place, monkeypatch, caplog):
    """And none any more once there is room."""
    with monkeypatch.context() as full:
        full.setattr(Path, "write_text", no_space)
        with pytest.raises(OptionError, match="No space left on device"):
            made("one", 1)
        for _ in range(3):
            assert "No space left on device" in cache.unavailable_reason()
    ((level, message),) = said(caplog)
    assert level == "WARNING"
    assert "No space left on device" in message
    assert not place.exists()
    assert cache.unavailable_reason() is None
    assert_whole(kept("one", 1))


def no_space(*arguments, **options):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


# Folders


@pytest.mark.parametrize(
    ("platform", "variables", "expected"),
    [
        ("linux", {"CTR_NLP_CACHE": "/own", "XDG_CACHE_HOME": "/xdg"}, "/own"),
        ("darwin", {"CTR_NLP_CACHE": "/own"}, "/own"),
        ("linux", {"XDG_CACHE_HOME": "/xdg"}, "/xdg/ctr_nlp"),
        ("linux", {"CTR_NLP_CACHE": "", "XDG_CACHE_HOME": ""}, "/home/someone/.cache/ctr_nlp"),
        ("linux", {}, "/home/someone/.cache/ctr_nlp"),
        ("darwin", {}, "/home/someone/Library/Caches/ctr_nlp"),
    ],
)
def test_the_folder_is_the_variables_else_the_users(platform, variables, expected, monkeypatch):
    users = {"linux": platformdirs.unix.Unix, "darwin": platformdirs.macos.MacOS}[platform]
    monkeypatch.setattr(platformdirs, "PlatformDirs", users)
    monkeypatch.setenv("HOME", "/home/someone")
    for name in ("CTR_NLP_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert cache.folder() == Path(expected)


def test_libraries_are_kept_in_the_folder_which_others_cannot_enter(place):
    path = kept("one", 1)
    assert path.parent.parent == place
    assert list(place.iterdir()) == [path.parent]
    for folder in (place, path.parent):
        assert folder.stat().st_mode & 0o077 == 0


@pytest.mark.parametrize("below", [".", "further/below"])
def test_where_no_folder_can_be_made_libraries_serve_this_process(below, tmp_path, monkeypatch, caplog):
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setenv("CTR_NLP_CACHE", str(tmp_path / "file" / below))
    assert cache.unavailable_reason() is None
    paths = [made(f"key {k}", k) for k in (1, 2)]
    assert [answer(path, tmp_path) for path in paths] == [1, 2]
    ((level, message),) = said(caplog)
    assert level == "WARNING"
    assert "cannot be kept" in message
    assert str(tmp_path / "file") in message
    assert (tmp_path / "file").read_text() == "not a folder"


def test_libraries_of_a_process_without_a_folder_go_with_it(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setenv("CTR_NLP_CACHE", str(tmp_path / "file"))
    path, number = answered(process("one", code(7)))
    assert number == 7
    assert not path.parent.parent.exists()


def test_where_nothing_can_be_kept_a_key_is_compiled_once_in_a_process(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setenv("CTR_NLP_CACHE", str(tmp_path / "file"))
    path = made("one", 1)
    assert cache.library("one", never) == path


def test_a_library_that_the_disk_of_the_cache_cannot_hold_serves_this_process(monkeypatch, caplog):
    monkeypatch.setattr(shutil, "copy", no_space)
    path = made("one", 1)
    assert ctypes.CDLL(str(path)).answer() == 1
    assert cache.library("one", never) == path
    ((level, message),) = said(caplog)
    assert level == "WARNING"
    assert "No space left on device" in message


def test_a_library_that_the_disk_of_the_cache_cannot_hold_leaves_nothing(place, monkeypatch):
    monkeypatch.setattr(shutil, "copy", no_space)
    made("one", 1)
    assert list(place.iterdir()) == []


def test_what_is_in_a_folder_that_cannot_be_written_is_used(place, caplog):
    path = kept("one", 1)
    place.chmod(0o500)
    try:
        assert cache.library("one", never) == path
    finally:
        place.chmod(0o700)
    assert said(caplog) == []


# Keys


def test_a_key_is_compiled_once_for_all_processes(place):
    calls = []
    own = cache.library("one", lambda: calls.append(1) or code(3))
    cache.library("one", never)
    cache._made.clear()
    path = cache.library("one", never)
    assert calls == [1]
    assert path.read_bytes() == own.read_bytes()
    before = path.stat()
    assert answered(process("one", "this is not C")) == (path, 3)
    assert (path.stat().st_ino, path.stat().st_mtime_ns) == (before.st_ino, before.st_mtime_ns)
    assert list(place.iterdir()) == [path.parent]
    assert_whole(path)


def test_a_library_is_held_against_its_digest_once_until_it_changes(monkeypatch):
    """Every new robot asks for its programs again, and reading them took longer than solving."""
    path, read, digest = kept("one", 1), list[Path](), cache._digest
    monkeypatch.setattr(cache, "_digest", lambda path, name: read.append(path) or digest(path, name))
    assert [cache.library("one", never) for _ in range(3)] == [path] * 3
    assert read == []
    os.utime(path)
    assert cache.library("one", never) == path
    assert read == [path]


def test_what_a_process_made_it_loads_from_a_place_of_its_own(place):
    path = made("one", 1)
    assert not path.is_relative_to(place)
    assert cache.library("one", never) == path


def test_every_key_has_its_own_library(place, tmp_path):
    paths = {kept(key, number): number for key, number in (("one", 1), ("two", 2), ("one ", 3))}
    assert len(paths) == 3
    assert {answer(path, tmp_path): number for path, number in paths.items()} == {1: 1, 2: 2, 3: 3}
    assert sorted(place.iterdir()) == sorted(path.parent for path in paths)


def test_compilers_their_versions_and_flags_have_their_own_libraries(tools, tmp_path, monkeypatch):
    """The compiler of CC, one of another version, another path and other flags; and back."""
    program(tools, f'[ -e {tools}/new ] && echo "version 2" >&2\nexec {REAL} "$@"', "mine")
    program(tools, f'exec {REAL} "$@"', "other")
    first = kept("one", 1)
    paths = [first]
    monkeypatch.setenv("CC", "mine")
    for step in (lambda: None, (tools / "new").touch, lambda: monkeypatch.setenv("CC", str(tools / "other"))):
        step()
        forget()
        paths.append(kept("one", 1))
    with monkeypatch.context() as other:
        other.setattr(cache, "COMPILER_FLAGS", (*cache.COMPILER_FLAGS, "-DANOTHER"))
        forget()
        paths.append(kept("one", 1))
    assert len(set(paths)) == 5
    assert {answer(path, tmp_path) for path in paths} == {1}
    monkeypatch.delenv("CC")
    forget()
    assert cache.library("one", never) == first


# Damage


def truncated(path, other):
    path.write_bytes(path.read_bytes()[:1000])


def emptied(path, other):
    path.write_bytes(b"")


def altered(path, other):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def without_library(path, other):
    path.unlink()


def a_folder_as_library(path, other):
    path.unlink()
    path.mkdir()


def altered_digest(path, other):
    digest = path.with_name("sha256")
    digest.write_text(digest.read_text()[::-1])


def digest_of_no_text(path, other):
    path.with_name("sha256").write_bytes(b"\xff" * 64)


def without_digest(path, other):
    path.with_name("sha256").unlink()


def an_empty_folder(path, other):
    shutil.rmtree(path.parent)
    path.parent.mkdir()


def a_file_instead(path, other):
    shutil.rmtree(path.parent)
    path.parent.write_text("not a folder")


def a_link_to_nothing(path, other):
    shutil.rmtree(path.parent)
    path.parent.symlink_to(path.parent.with_name("nowhere"))


def the_library_of_another_key(path, other):
    shutil.copy(other, path)


def the_folder_of_another_key(path, other):
    shutil.rmtree(path.parent)
    shutil.copytree(other.parent, path.parent)


DAMAGES = [
    *(truncated, emptied, altered, without_library, a_folder_as_library),
    *(altered_digest, digest_of_no_text, without_digest),
    *(an_empty_folder, a_file_instead, a_link_to_nothing),
    *(the_library_of_another_key, the_folder_of_another_key),
]


@pytest.mark.parametrize("damage", DAMAGES)
def test_what_is_not_what_was_built_is_made_anew_and_never_loaded(damage, place, tmp_path):
    path, other = kept("one", 1), kept("two", 2)
    before = path.read_bytes()
    damage(path, other)
    calls = []
    found = cache.library("one", lambda: calls.append(1) or code(1))
    assert calls == [1]
    assert answer(found, tmp_path) == 1
    cache._made.clear()
    found = cache.library("one", never)
    assert found == path
    assert found.read_bytes()[:4] == before[:4]
    assert answer(found, tmp_path) == 1
    assert_whole(found)
    assert answer(cache.library("two", never), tmp_path) == 2
    assert {each.name for each in place.iterdir() if not each.name.startswith("building-")} == {
        path.parent.name,
        other.parent.name,
    }


@pytest.mark.parametrize("damage", DAMAGES)
def test_what_is_damaged_is_made_whole_again_by_the_process_that_made_it(damage, tmp_path):
    """Without compiling, and what it loaded itself is as it was."""
    other, own = kept("two", 2), made("one", 1)
    (found,) = (path for path in cache.folder().iterdir() if path != other.parent)
    damage(found / "library.so", other)
    assert cache.library("one", never) == own
    assert answer(own, tmp_path) == 1
    cache._made.clear()
    assert answer(cache.library("one", never), tmp_path) == 1
    assert_whole(found / "library.so")


@pytest.mark.parametrize("damage", [truncated, an_empty_folder, a_file_instead, a_link_to_nothing])
def test_where_something_was_damaged_other_libraries_are_kept_and_it_is_gone(damage, place, caplog):
    path = kept("one", 1)
    damage(path, None)
    paths = [kept("one", 1), kept("two", 2)]
    assert said(caplog) == []
    assert sorted(place.iterdir()) == sorted(each.parent for each in paths)


def test_a_build_that_is_gone_once_it_was_listed_hinders_nothing(monkeypatch, caplog):
    """Another process has just finished it."""
    monkeypatch.setattr(Path, "glob", lambda folder, pattern: [folder / "building-gone"])
    assert_whole(kept("one", 1))
    assert said(caplog) == []


def test_a_library_of_another_user_is_not_used(place, tmp_path, monkeypatch):
    path = kept("one", 1)
    disowned = {path.stat().st_ino}
    monkeypatch.setattr(Path, "stat", stat_that_disowns(disowned.__contains__))
    assert answer(made("one", 2), tmp_path) == 2
    cache._made.clear()
    found = cache.library("one", never)
    assert found == path
    assert answer(found, tmp_path) == 2


def test_where_no_file_belongs_to_its_user_libraries_still_load(tmp_path, monkeypatch):
    """As on file systems that know one owner only."""
    monkeypatch.setattr(Path, "stat", stat_that_disowns(lambda inode: True))
    path = made("one", 1)
    assert answer(path, tmp_path) == 1
    assert cache.library("one", never) == path


def stat_that_disowns(chosen, real=Path.stat):
    """Path.stat, but files whose inodes are chosen belong to another user."""

    def stat(path, **options):
        found = real(path, **options)
        return os.stat_result((*found[:4], found.st_uid + chosen(found.st_ino), *found[5:10]))

    return stat


# Processes


def test_a_build_that_is_killed_is_never_taken(place, tools, tmp_path, monkeypatch):
    """The compiler writes half a library and then waits for ever, until the whole process group is killed."""
    own, slow, started = tmp_path / "own", tools / "slow", tools / "started"
    own.mkdir()
    half = f"printf half > library.so; : > {started}; exec sleep 600"
    program(tools, f'case " $* " in *" -E "*) ;; *) [ -e {slow} ] && {{ {half}; }};; esac\nexec {REAL} "$@"')
    slow.touch()
    with monkeypatch.context() as other:
        other.setenv("TMPDIR", str(own))
        running = process("one", code(1))
    await_file(started, running)
    os.killpg(running.pid, signal.SIGKILL)
    running.communicate()
    slow.unlink()
    (left,) = own.rglob("library.so")
    assert left.read_bytes() == b"half"
    assert not place.exists()
    path = kept("one", 1)
    assert answer(path, tmp_path) == 1
    assert list(place.iterdir()) == [path.parent]


def test_what_was_half_kept_is_never_taken_and_removed(place, tmp_path):
    """Another process was killed while it copied, and a third one is at it."""
    left, held = place / "building-other", place / "building-third"
    for folder in (left, held):
        folder.mkdir(parents=True)
        (folder / "library.so").write_bytes(b"half")
    with lock_folder(held):
        path = kept("one", 1)
    assert answer(path, tmp_path) == 1
    assert sorted(place.iterdir()) == sorted([path.parent, held])


def test_without_locks_what_was_half_kept_is_removed_when_old(place, monkeypatch):
    monkeypatch.setattr(folder_lock, "fcntl", None)
    left = place / "building-other"
    left.mkdir(parents=True)
    path = kept("one", 1)
    assert sorted(place.iterdir()) == sorted([path.parent, left])
    ago = time.time() - cache.BUILD_FOLDER_ABANDONED_AFTER_S - 60
    os.utime(left, (ago, ago))
    os.utime(path.parent, (ago, ago))
    other = kept("two", 2)
    assert sorted(place.iterdir()) == sorted([path.parent, other.parent])
    assert cache.library("one", never) == path


def test_what_a_killed_process_had_loaded_is_removed(tmp_path, monkeypatch):
    """What living processes have loaded stays, and goes when they end."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    wait = BUILD + "sys.stdout.flush(); sys.stdin.read()"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    killed, living = (
        subprocess.Popen([sys.executable, "-c", wait, key, code(1)], **pipes) for key in ("one", "two")
    )
    paths = [Path(one.stdout.readline().split()[0]) for one in (killed, living)]
    killed.kill()
    killed.communicate()
    assert [path.exists() for path in paths] == [True, True]
    answered(process("three", code(3)))
    assert [path.exists() for path in paths] == [False, True]
    (left,) = tmp_path.glob("ctr_nlp-*")
    assert paths[1].is_relative_to(left)
    living.communicate("")
    assert not list(tmp_path.glob("ctr_nlp-*"))


@pytest.mark.parametrize("damage", [None, truncated], ids=["new", "damaged"])
def test_builders_at_once_keep_one_library(damage, place, tools, tmp_path):
    """No compiler of a library ends before every process has started its own."""
    builders, running = 4, tools / "running"
    running.mkdir()
    wait = f': > {running}/$$; while [ "$(ls {running} | wc -l)" -lt {builders} ]; do sleep 0.02; done'
    program(tools, f'case " $* " in *" -E "*) ;; *) {wait};; esac\nexec {REAL} "$@"')
    if damage is not None:
        for k in range(builders):
            (running / f"early-{k}").touch()
        damage(kept("one", 9), None)
        cache._made.clear()
        shutil.rmtree(running)
        running.mkdir()
    processes = [process("one", code(9)) for _ in range(builders)]
    results = [answered(one) for one in processes]
    assert len(list(running.iterdir())) == builders
    assert [number for _, number in results] == [9] * builders
    assert len({path for path, _ in results}) == builders
    assert not any(path.exists() or path.is_relative_to(place) for path, _ in results)
    path = cache.library("one", never)
    assert list(place.iterdir()) == [path.parent]
    assert answer(path, tmp_path) == 9
    assert_whole(path)


def test_a_build_that_another_process_takes_for_the_bad_one_it_saw_still_loads(place, tmp_path, monkeypatch):
    """Both saw a bad library; the other moves away what has its name, which is good by now, and then waits."""
    path, moved = kept("one", 1), []
    truncated(path, None)
    cache._made.clear()

    def keep(made, folder, real=cache._keep):
        real(made, folder)
        assert cache._is_complete(folder)
        moved.append(folder.rename(folder.with_name("building-bad-other")))

    monkeypatch.setattr(cache, "_keep", keep)
    found = made("one", 1)
    assert answer(found, tmp_path) == 1
    shutil.rmtree(moved.pop())
    assert answer(found, tmp_path) == 1
    assert cache.library("one", never) == found


def test_what_another_process_kept_first_stays(place):
    """It is not away for a moment, as others may be about to load it."""
    first = []

    def code_in_the_meantime():
        assert answered(process("one", code(1)))[1] == 1
        first.extend(place.iterdir())
        first.append(first[0].stat().st_ino)
        return code(1)

    cache.library("one", code_in_the_meantime)
    folder, inode = first
    assert list(place.iterdir()) == [folder]
    assert folder.stat().st_ino == inode
