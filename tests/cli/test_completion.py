"""Completion, by the shell that it is for."""

import shutil
import subprocess
from pathlib import Path

import pytest

ASK = """
source dds.sh
COMP_WORDS=("$@"); COMP_CWORD=$((${#COMP_WORDS[@]}-1)); _dds; printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["sk"], ["skill"]),
        (["skill", "f"], ["fit"]),
        (["skill", "fit", "--model.enc"], ["--model.encoder=", "--model.encoder_heads=", "--model.encoder_layers="]),
        (["data", "co"], ["collect"]),
        (["evaluate", "runs/x", "--sel"], ["--selection"]),
        (["run", "x", "--until=re"], ["--until=relabel", "--until=report"]),
        (["run", "x", "--skill.model.num"], ["--skill.model.num_skills="]),
    ],
)
def test_a_word_is_completed(dds, words, found):
    Path("dds.sh").write_text(dds("completion", "bash").out)
    ran = subprocess.run(["bash", "-c", ASK, "", "dds", *words], capture_output=True, text=True, check=True)
    assert sorted(ran.stdout.split()) == found


def test_zsh_gets_the_same_through_its_bridge(dds):
    answer = dds("completion", "zsh").out
    assert answer.startswith("autoload -U +X bashcompinit")
    assert "complete -o default -F _dds dds" in answer
