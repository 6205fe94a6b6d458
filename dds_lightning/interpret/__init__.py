"""Figures and tables of data, skills, policies and runs; every function reads tables or plays the real environment.

The names below are imported on first use, because some need torch and the simulator.
"""

import importlib
from typing import Any

_FILES = {
    "atlas.build": ("Atlas", "make_atlas"),
    "atlas.page": ("write_atlas", "write_pictures"),
    "atlas.pictures": ("most_different",),
    "draw.charts": (
        *("plot_comparison", "plot_distances", "plot_diversity", "plot_effects", "plot_matrix"),
        *("plot_recovery", "plot_round_trip", "plot_transitions", "plot_where"),
    ),
    "draw.clip": ("replay_clip", "write_clip"),
    "draw.maze": ("plot_skills_by_start", "plot_starts_by_skill", "plot_trajectories"),
    "draw.png": ("png_bytes", "small_png"),
    "draw.rendering": ("plot_rendered", "render_frames"),
    "draw.stitching": ("draw_timeline", "plot_stitching"),
    "draw.strobe": ("body_clip", "plot_strobes"),
    "draw.values": ("plot_policy_map", "plot_value_map", "value_table"),
    "measure.body": ("body_frames", "root_path"),
    "measure.comparison": ("cluster_skills", "compare_recovery", "decoding_error"),
    "measure.information": ("mutual_information",),
    "measure.recovery": ("code_recovery", "encode_replays", "round_trip"),
    "measure.replay": ("replay_codes", "simulator"),
    "measure.states": ("body_states", "draw_states", "junctions", "rest_states"),
    "measure.statistics": (
        *("code_distances", "code_segments", "decoder_diversity", "nearest_codes", "segment_effects"),
        *("skill_table", "transition_matrix"),
    ),
}
_HOMES = {name: file for file, names in _FILES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import a name from its file on first use (PEP 562)."""
    if name in _HOMES:
        return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """List the lazily imported names as well, for tab completion."""
    return sorted({*globals(), *_HOMES})
