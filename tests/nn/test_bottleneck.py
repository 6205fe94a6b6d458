"""What every skill space offers, whether its skills are discrete or not."""

from types import SimpleNamespace

import pytest
import torch

from dds_lightning.errors import UserError
from dds_lightning.nn.codebook import Codebook
from dds_lightning.nn.gaussian import GaussianBottleneck
from dds_lightning.skill import BOTTLENECKS

SETTINGS = SimpleNamespace(
    num_skills=4, skill_dim=3, codebook_init="kmeans", codebook_ema=None, commitment=0.5, kl_weight=0.2
)


@pytest.mark.parametrize("name", BOTTLENECKS)
def test_skills_have_vectors_weighted_terms_and_codes_if_they_are_discrete(name):
    torch.manual_seed(0)
    space = BOTTLENECKS[name].build(SETTINGS).train()
    encodings = torch.randn(6, space.widths * 3, requires_grad=True)
    skill = space(encodings)
    assert skill.vectors.shape == (6, 3)
    assert (skill.codes is not None) == space.discrete
    if skill.codes is not None:
        torch.testing.assert_close(skill.vectors, space.lookup(skill.codes))
    (skill.vectors.sum() + sum(term.weight * term.value for term in skill.terms.values())).backward()
    assert encodings.grad.abs().max() > 0


def test_terms_carry_the_weights_of_the_settings():
    encodings = torch.randn(6, 6)
    terms = Codebook.build(SETTINGS)(encodings[:, :3]).terms
    assert {name: term.weight for name, term in terms.items()} == {"codebook": 1.0, "commitment": 0.5}
    terms = GaussianBottleneck.build(SETTINGS)(encodings).terms
    assert {name: term.weight for name, term in terms.items()} == {"kl": 0.2}


def test_a_gaussian_draws_while_training_gives_its_mean_otherwise_and_has_nothing_to_start_revive_or_report():
    def never():
        raise AssertionError("no encodings are needed")

    space = GaussianBottleneck()
    encodings = torch.tensor([[1.0, -2.0, 0.0, 0.0]]).repeat(20_000, 1)
    assert torch.equal(space.eval()(encodings).vectors, encodings[:, :2])
    drawn = space.train()(encodings).vectors
    torch.testing.assert_close(drawn.mean(dim=0), torch.tensor([1.0, -2.0]), atol=0.05, rtol=0)
    torch.testing.assert_close(drawn.std(dim=0), torch.ones(2), atol=0.05, rtol=0)
    space.start(never)
    assert space.revive(never, 0.5, torch.Generator()) == space.health() == {}
    with pytest.raises(UserError, match="give vectors"):
        space.lookup(torch.tensor([0]))


def test_a_codebook_starts_once_and_says_which_rows_it_revived():
    points = torch.randn(64, 3, generator=torch.Generator().manual_seed(0))
    book, asked = Codebook(4, 3), []

    def encodings():
        asked.append(1)
        return points

    book.start(encodings)
    vectors = book.vectors.detach().clone()
    book.start(encodings)
    assert len(asked) == 1
    assert torch.equal(book.vectors, vectors)
    book.usage[2] = 0.0
    (rows,) = book.revive(encodings, 0.5, torch.Generator().manual_seed(0)).values()
    assert rows.tolist() == [2]
    assert book.health()["perplexity"].item() == pytest.approx(4.0)
