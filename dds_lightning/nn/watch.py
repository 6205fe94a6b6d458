"""What a look at a critic and its policy's weights says while they train."""

from collections.abc import Mapping

from torch import Tensor


def complaints(terms: Mapping[str, Tensor], value_range: Tensor, weight_clip: float) -> list[str]:
    """Say whether values cannot be sums of rewards, and whether most AWR weights are clipped.

    Args:
        terms: Scalars `v_min` and `v_max` of a batch, and `clipped_share` where the actor learns.
        value_range: (2,) lowest and highest value that rewards and discounts of the data allow; infinite if unknown.
        weight_clip: Upper bound of the weights.
    """
    low, high = value_range.tolist()
    least, most = terms["v_min"].item(), terms["v_max"].item()
    slack = 0.1 * (high - low) if high - low < float("inf") else float("inf")
    clipped = terms["clipped_share"].item() if "clipped_share" in terms else 0.0
    found = []
    if least < low - slack or most > high + slack:
        found.append(
            f"V runs from {least:.3g} to {most:.3g}, but the data's rewards and discounts allow only {low:.3g} to "
            f"{high:.3g}: the critic diverges. Check that terminations are in the data, scale the rewards down, or "
            "lower lr or tau."
        )
    if clipped > 0.5:
        found.append(
            f"{100 * clipped:.0f} % of the AWR weights are clipped at {weight_clip:g}: the policy clones them all "
            "alike. Lower alpha."
        )
    return found
