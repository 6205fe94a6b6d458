"""What jobs of a study write down beside their results."""

import pytest

from dds_lightning.errors import UserError
from dds_lightning.grid.results import CELLS, refuse_other_study
from dds_lightning.grid.work import _by_hand
from dds_lightning.saving.run_directory import write_json


def test_a_command_names_places_from_the_studys_own_folder(tmp_path):
    folder = tmp_path / "my study" / "nodes" / "skill-1"
    words = [
        "skill",
        "fit",
        f"--data.data=local:{folder.parent}/data-2/d",
        f"--checkpoint.dirpath={folder}",
        "--a=[8, 8]",
    ]
    assert _by_hand(words, folder) == (
        "dds skill fit --data.data=local:nodes/data-2/d --checkpoint.dirpath=nodes/skill-1 '--a=[8, 8]'"
    )
    assert (
        _by_hand(["evaluate", "--skill=/elsewhere/nodes/s.ckpt"], folder)
        == "dds evaluate --skill=/elsewhere/nodes/s.ckpt"
    )


@pytest.mark.parametrize(
    ("title", "file", "refused"),
    [
        ("Mine", "a/k.yaml", False),
        ("Renamed", "a/k.yaml", False),
        ("Mine", "b/k.yaml", False),
        ("Other", "b/k.yaml", True),
    ],
)
def test_another_study_file_of_the_same_name_does_not_take_a_studys_folder(tmp_path, title, file, refused):
    place = tmp_path / "out" / "k"
    refuse_other_study(place, title, tmp_path / file)  # nothing is there yet
    there = {"study": {"title": "Mine"}, "cells": [], "command": "", "file": str(tmp_path / "a/k.yaml")}
    write_json(place / CELLS, there)
    if not refused:
        refuse_other_study(place, title, tmp_path / file)
        return
    with pytest.raises(UserError, match=r"holds the study 'Mine' of .*a/k\.yaml, another file of the same name"):
        refuse_other_study(place, title, tmp_path / file)
