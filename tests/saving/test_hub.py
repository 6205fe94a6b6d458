"""The hub, played by a folder: what is sent, what arrives, what is refused."""

import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from dds_lightning.agent import DDSAgent
from dds_lightning.errors import UserError
from dds_lightning.saving.hub import is_hub, pull, push
from dds_lightning.saving.published import CONTENTS, SUMS

SHIPPED = Path(__file__).parents[2] / "checkpoints" / "pointmaze-large"


class FolderHub:
    """The three functions of huggingface_hub that are used, over a local folder."""

    def __init__(self, root):
        self.root = root

    def create_repo(self, repo, private, exist_ok, token):
        assert exist_ok
        (self.root / repo).mkdir(parents=True, exist_ok=True)

    def upload_folder(self, repo_id, folder_path, revision, token, allow_patterns, commit_message):
        for path in Path(folder_path).iterdir():
            if path.name in allow_patterns:
                shutil.copy(path, self.root / repo_id / path.name)
        return SimpleNamespace(__str__=lambda: repo_id)

    def snapshot_download(self, repo, revision, token, allow_patterns):
        if not (self.root / repo).is_dir():
            raise OSError(f"404: {repo}\nmore")
        return str(self.root / repo)


@pytest.fixture
def hub(tmp_path, monkeypatch):
    fake = FolderHub(tmp_path / "hub")
    monkeypatch.setitem(sys.modules, "huggingface_hub", fake)
    return fake


def test_what_is_pushed_comes_back_and_acts(hub):
    push(SHIPPED, "hf:somebody/maze")
    assert sorted(path.name for path in (hub.root / "somebody/maze").iterdir()) == sorted([*CONTENTS, SUMS])
    agent = DDSAgent.load(pull("hf:somebody/maze"))
    assert agent.golden() == DDSAgent.load(SHIPPED).golden()


def test_only_the_five_files_travel(hub, tmp_path):
    with_more = tmp_path / "agent"
    shutil.copytree(SHIPPED, with_more)
    (with_more / "secret.pem").write_text("key")
    push(with_more, "hf:somebody/maze")
    assert not (hub.root / "somebody/maze/secret.pem").exists()


def test_a_changed_file_is_refused_before_sending_and_after_fetching(hub, tmp_path):
    push(SHIPPED, "hf:somebody/maze")
    card = hub.root / "somebody/maze/README.md"
    card.write_text("another card")
    with pytest.raises(UserError, match=r"README.md is not the file that was published"):
        pull("hf:somebody/maze")
    damaged = tmp_path / "agent"
    shutil.copytree(SHIPPED, damaged)
    (damaged / "metrics.json").write_text("{}")
    with pytest.raises(UserError, match=r"metrics.json is not the file"):
        push(damaged, "hf:somebody/other")
    assert not (hub.root / "somebody/other").exists()


PLACES = ["hf:", "hf:maze", "hf:a/b/c", "hf:../x", "hf:a/b@", "hf:./.", "hf:a/.", "hf:.a/b", "hf:-a/b", "hf:a/b@.."]
PLACES += ["hf:a/b.git", "hf:\u00e4/b", "hf:a--b/c", "https://a/b"]


@pytest.mark.parametrize("place", PLACES)
def test_other_places_are_refused(hub, place):
    with pytest.raises(UserError, match="is not a Hub address, expected hf:OWNER/NAME"):
        pull(place)


def test_a_repository_that_is_not_there_is_one_sentence(hub):
    with pytest.raises(UserError, match=r"^hf:somebody/nothing could not be fetched: 404: somebody/nothing$"):
        pull("hf:somebody/nothing")


def test_without_the_extra_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(UserError, match=r"pip install -e '\.\[hub\]' -c constraints.txt` in this project's checkout"):
        pull("hf:somebody/maze")


def test_places_on_the_hub_are_told_from_folders():
    assert is_hub("hf:a/b")
    assert not is_hub(Path("checkpoints/pointmaze-large"))
