"""Files that are either whole or not there."""

import os
import stat

import pytest

from sb3_e2c.saving import atomic_write


def write(target, content):
    with atomic_write(target) as file:
        file.write(content)


def test_what_fails_half_way_leaves_the_old_file_and_nothing_else(tmp_path):
    target = tmp_path / "model.zip"
    write(target, b"old")

    def stop(file):
        file.write(b"ne")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), atomic_write(target) as file:
        stop(file)
    assert target.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [target]


def test_folders_are_made_and_others_may_read_what_they_may_read_of_other_files(tmp_path):
    target, other = tmp_path / "a/b/model.zip", tmp_path / "other"
    write(target, b"new")
    other.write_bytes(b"")
    assert stat.S_IMODE(target.stat().st_mode) == stat.S_IMODE(other.stat().st_mode)


@pytest.mark.parametrize("exists", [True, False])
def test_a_link_stays_one(tmp_path, exists):
    file, link = tmp_path / "elsewhere/model.zip", tmp_path / "best.zip"
    link.symlink_to(file)
    if exists:
        write(file, b"old")
    write(link, b"new")
    assert link.is_symlink()
    assert file.read_bytes() == b"new"


def test_a_device_is_written_to_not_replaced(tmp_path):
    reading, writing = os.pipe()
    link = tmp_path / "stdout"
    link.symlink_to(f"/dev/fd/{writing}")
    write(link, b"new")
    os.close(writing)
    assert os.read(reading, 10) == b"new"
    os.close(reading)
    assert link.is_symlink()
