"""Atomic writes: whole or not at all, with an error that names the file."""

from __future__ import annotations

from pathlib import Path

import pytest

from envs.files import atomic, files_below, new_neighbour, put, write_json, write_text


def test_what_stood_there_stays_until_the_new_file_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "a.txt"
    write_text(path, "old")
    with pytest.raises(KeyboardInterrupt), atomic(path) as part:
        part.write_text("half")
        raise KeyboardInterrupt
    assert path.read_text() == "old" and list(path.parent.iterdir()) == [path]
    write_text(path, "new")
    assert path.read_text() == "new"


def test_a_folder_replaces_a_folder(tmp_path: Path) -> None:
    path = tmp_path / "artefact"
    for name in ("one", "two"):
        with atomic(path) as part:
            part.mkdir()
            (part / name).touch()
    assert [child.name for child in path.iterdir()] == ["two"]


def test_errors_name_the_file_and_the_fix(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match=r"cannot write .*file/below.*free disk space"):
        write_text(tmp_path / "file" / "below", "")
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "a.json", {"loss": float("nan")})
    assert not (tmp_path / "a.json").exists()


def test_the_first_of_several_that_make_the_same_folder_wins(tmp_path: Path) -> None:
    path, parts = tmp_path / "deep" / "cache", []
    for number in range(3):
        parts.append(new_neighbour(tmp_path / "deep" / "cache"))
        (parts[-1] / "stamp").write_text("new" if number else "old")
    assert len(set(parts)) == 3
    for part in parts:
        put(part, path, lambda: (path / "stamp").read_text() == "new")
    assert (path / "stamp").read_text() == "new"  # the old one had to go, the second new one was too late
    assert [part.exists() for part in parts] == [False, False, True]


def test_files_below_are_found_behind_links_without_going_round(tmp_path: Path) -> None:
    folder, bulk = tmp_path / "folder", tmp_path / "bulk"
    for path in (folder / "a.txt", folder / "deep/b.txt", bulk / "c.txt"):
        write_text(path, "")
    (folder / "link").symlink_to(bulk)
    (bulk / "back").symlink_to(folder)
    (folder / "nowhere").symlink_to(tmp_path / "gone")
    found = [path.relative_to(folder).as_posix() for path in files_below(folder)]
    assert found == ["a.txt", "deep/b.txt", "link/c.txt"] and not list(files_below(tmp_path / "gone"))
