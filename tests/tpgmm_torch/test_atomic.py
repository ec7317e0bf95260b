"""Files and folders replaced in one step, whatever happens on the way."""

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.refusals import refused
from tpgmm_torch import atomic
from tpgmm_torch.atomic import consistent, contents, read_whole, recover, replacing

#: A process that saves, and dies at the n-th thing that it asks of the system, for every n;
#: prints what is there then.
DYING = """
import itertools, os, sys
from pathlib import Path
from atomic import recover, replacing

kind, path = sys.argv[1], Path(sys.argv[2])

def save(text):
    with replacing(path, keep=kind == "kept") as new:
        if kind == "file":
            new.write_text(text)
            return
        new.mkdir()
        (new / "settings").write_text(text)
        (new / "weights").write_text(text)

def die_at(nth):
    count = itertools.count()
    sys.addaudithook(lambda *_: os._exit(7) if next(count) == nth else None)

code, nth = 7, 0
while code == 7:
    save("old")
    pid = os.fork()
    if not pid:
        die_at(nth)
        save("new")
        os._exit(0)
    code, nth = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), nth + 1
    recover(path)
    files = [path] if kind == "file" else sorted(path.iterdir())
    print(code, *(file.read_text() for file in files))
"""
#: What may be there: the old or the new, of all files.
WHOLE = {"file": ["old", "new"], "folder": ["old old", "new new"]}
WHOLE["kept"] = [f"mine {text}" for text in WHOLE["folder"]]


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def save(path: Path, text: str, *, keep: bool = False) -> None:
    with replacing(path, keep=keep) as new:
        new.mkdir()
        (new / "settings").write_text(text)
        (new / "weights").write_text(text)


def test_a_file_cannot_be_a_folder_above(tmp_path):
    (tmp_path / "model").write_text("kept")
    inside = replacing(tmp_path / "model" / "new" / "one")
    with pytest.raises(NotADirectoryError, match=r"Not a directory.*model"), inside:
        pass
    assert (tmp_path / "model").read_text() == "kept"


def test_a_file_is_replaced_and_its_folders_are_made(tmp_path):
    path = tmp_path / "a" / "b" / "notes.txt"
    for text in ("old", "new"):
        with replacing(path) as new:
            assert new.name == path.name  # what asks for its suffix is answered
            new.write_text(text)
        assert path.read_text() == text
        assert names(path.parent) == ["notes.txt"]


def test_a_folder_is_replaced_as_a_whole(tmp_path):
    for text in ("old", "new"):
        save(tmp_path / "saved", text)
        (tmp_path / "saved" / text).mkdir()
    assert names(tmp_path) == ["saved"]
    assert names(tmp_path / "saved") == ["new", "settings", "weights"]
    assert (tmp_path / "saved" / "weights").read_text() == "new"


def test_other_files_of_a_folder_may_stay(tmp_path):
    path = tmp_path / "saved"
    save(path, "old")
    (path / "a" / "empty").mkdir(parents=True)
    (path / "a" / "mine").write_text("mine")
    (path / "link").symlink_to("nowhere")
    save(path, "new", keep=True)
    assert names(path) == ["a", "link", "settings", "weights"]
    assert names(path / "a") == ["empty", "mine"]
    assert (path / "a" / "mine").read_text() == "mine"
    assert (path / "link").readlink() == Path("nowhere")
    assert (path / "settings").read_text() == (path / "weights").read_text() == "new"


def test_files_that_stay_are_copied_where_links_cannot_be(tmp_path, monkeypatch):
    save(tmp_path / "saved", "old")
    (tmp_path / "saved" / "mine").write_text("mine")

    def refuse(*arguments, **options):
        raise PermissionError

    monkeypatch.setattr(os, "link", refuse)
    save(tmp_path / "saved", "new", keep=True)
    assert (tmp_path / "saved" / "mine").read_text() == "mine"
    assert (tmp_path / "saved" / "weights").read_text() == "new"


@pytest.mark.parametrize("failing", ["mkdir", "write_text", "rename", "replace", "fsync"])
@pytest.mark.parametrize("nth", [1, 2])
def test_what_fails_leaves_the_old(tmp_path, monkeypatch, failing, nth):
    path, calls = tmp_path / "saved", []
    save(path, "old")
    owner = os if failing == "fsync" else Path
    original = getattr(owner, failing)

    def fail(*arguments, **options):
        calls.append(arguments)
        if len(calls) == nth:
            raise KeyboardInterrupt
        return original(*arguments, **options)

    monkeypatch.setattr(owner, failing, fail)
    try:
        save(path, "new")
        failed = False
    except KeyboardInterrupt:
        failed = True
    monkeypatch.undo()
    assert failed == (len(calls) >= nth)
    assert names(tmp_path) == ["saved"]
    assert {file.read_text() for file in path.iterdir()} == {"old" if failed else "new"}


@pytest.mark.parametrize("kind", ["pipe", "folder", "pointer", "nothing"])
def test_what_is_not_there_as_a_whole_is_not_read(tmp_path, kind):
    path = tmp_path / "file"
    if kind == "pipe":
        os.mkfifo(path)  # nobody writes to it: reading would not end
    elif kind == "folder":
        path.mkdir()
    elif kind == "pointer":
        path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:1\nsize 9\n")
    message = {"pointer": "`git lfs pull`", "nothing": "No such file"}.get(
        kind, "regular file|directory"
    )
    refused(lambda: read_whole(path), OSError, message)
    with replacing(tmp_path / "other") as new:
        new.write_bytes(b"version")
    assert read_whole(tmp_path / "other") == b"version"


def test_what_the_dead_left_is_used_or_removed_and_nothing_else(tmp_path):
    path = tmp_path / "saved"
    save(path, "old")
    for name in (".saved.settings", ".saved.b.new", ".saved.new", ".other"):
        (tmp_path / name).mkdir()
    recover(path)  # nothing to do
    path.rename(tmp_path / ".saved.previous")
    recover(path)
    assert (path / "weights").read_text() == "old"
    save(tmp_path / "later", "older")
    (tmp_path / "later").rename(tmp_path / ".saved.previous")
    save(path, "new")
    assert (path / "weights").read_text() == "new"
    assert names(tmp_path) == [".other", ".saved.b.new", ".saved.settings", "saved"]


@pytest.mark.parametrize("kind", WHOLE)
def test_what_dies_on_the_way_leaves_the_old_or_the_new(tmp_path, kind):
    path = tmp_path / "saved"
    if kind == "kept":
        path.mkdir()
        (path / "mine").write_text("mine")
    done = subprocess.run(
        [sys.executable, "-c", DYING, kind, str(path)],
        env=os.environ | {"PYTHONPATH": str(Path(atomic.__file__).parent)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    old, new = WHOLE[kind]
    *died, last = done.stdout.splitlines()
    assert last == f"0 {new}"
    assert len(died) > 10
    turn = died.index(f"7 {new}")
    assert died == [f"7 {old}"] * turn + [f"7 {new}"] * (len(died) - turn)


def test_permissions_are_those_of_any_other_file(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    with replacing(tmp_path / "new file") as new:
        new.write_text("")
    save(tmp_path / "new folder", "new")
    for kind in ("file", "folder"):
        modes = {
            stat.S_IMODE((tmp_path / name).stat().st_mode) for name in (kind, f"new {kind}")
        }
        assert len(modes) == 1


def test_a_folder_that_is_replaced_while_it_is_read_is_read_again(tmp_path):
    path, reads = tmp_path / "saved", []
    save(path, "old")

    def read():
        first = (path / "settings").read_text()
        if not reads:
            save(path, "new")
        reads.append(first + (path / "weights").read_text())
        if reads[-1] != 2 * first:
            raise ValueError(reads[-1])
        return reads[-1]

    assert consistent(path, read) == "newnew"
    assert reads == ["oldnew", "newnew"]
    (path / "weights").write_text("else")
    refused(lambda: consistent(path, read), ValueError, "newelse")


@pytest.mark.parametrize("here", [".", "inner/.."])
def test_the_present_folder_is_replaced_too(tmp_path, monkeypatch, here):
    path = tmp_path / "saved"
    (path / "inner").mkdir(parents=True)
    monkeypatch.chdir(path)
    save(here, "new")
    assert names(tmp_path) == ["saved"]
    assert names(path) == ["settings", "weights"]


def test_what_file_managers_leave_behind_does_not_count(tmp_path):
    for name in (".DS_Store", "._config.json", "Thumbs.db", "desktop.ini"):
        (tmp_path / name).touch()
    assert contents(tmp_path) == set()
    for name in (".git", ".env", "thumbs.txt"):
        (tmp_path / name).touch()
    assert contents(tmp_path) == {".git", ".env", "thumbs.txt"}
