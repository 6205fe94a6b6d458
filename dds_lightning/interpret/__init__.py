"""Figures and tables of data, skills, policies and runs; every function reads tables or plays the real environment.

The names below are imported on first use, because some need torch and the simulator.
"""

import importlib
from typing import Any

_ROOMS = {
    "atlas": ("Atlas", "make_atlas", "write_atlas", "write_pictures"),
    "atlas_pictures": ("most_different",),
    "body": ("body_frames", "root_path"),
    "charts": (
        *("plot_comparison", "plot_distances", "plot_diversity", "plot_effects", "plot_matrix"),
        *("plot_recovery", "plot_round_trip", "plot_transitions", "plot_where"),
    ),
    "clip": ("replay_clip", "write_clip"),
    "comparison": ("cluster_skills", "compare_recovery", "decoding_error"),
    "information": ("mutual_information",),
    "maze": ("plot_skills_by_start", "plot_starts_by_skill", "plot_trajectories"),
    "png": ("png_bytes", "small_png"),
    "recovery": ("code_recovery", "encode_replays", "round_trip"),
    "rendering": ("plot_rendered", "render_frames"),
    "replay": ("body_states", "draw_states", "junctions", "replay_codes", "rest_states", "simulator"),
    "statistics": (
        *("code_distances", "code_segments", "decoder_diversity", "nearest_codes", "segment_effects"),
        *("skill_table", "transition_matrix"),
    ),
    "stitching": ("draw_timeline", "plot_stitching"),
    "strobe": ("body_clip", "plot_strobes"),
    "values": ("plot_policy_map", "plot_value_map", "value_table"),
}
_HOMES = {name: room for room, names in _ROOMS.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import a name from its room on first use (PEP 562)."""
    if name in _HOMES:
        return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """List the lazily imported names as well, for tab completion."""
    return sorted({*globals(), *_HOMES})
