"""Imports that need help: paths of earlier versions, and a foreign package with the name of one of ours."""

import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import InspectLoader, Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from types import CodeType, ModuleType

NAME = "datamodules"
"""Our second package; projects made from Lightning's templates have one of that name too."""
OURS = Path(__file__).parents[1] / NAME

_DRAW = (
    *("bars", "charts", "clip", "curves", "dataset", "drawing", "gif"),
    *("maze", "palette", "png", "rendering", "stitching", "strobe", "values"),
)
_MEASURE = ("body", "comparison", "information", "recovery", "replay", "statistics")

MOVED = {
    "dds_lightning.reports": "dds_lightning.console.reports",
    "dds_lightning.training.interrupts": "dds_lightning.console.interrupts",
    "dds_lightning.files": "dds_lightning.saving.files",
    "dds_lightning.checkpointing": "dds_lightning.saving.checkpoint",
    "dds_lightning.publishing": "dds_lightning.saving.published",
    "dds_lightning.hub": "dds_lightning.saving.hub",
    "dds_lightning.stages": "dds_lightning.saving.run_directory",
    "dds_lightning.actors": "dds_lightning.rollout.actors",
    "dds_lightning.seating": "dds_lightning.rollout.schedule",
    "dds_lightning.results": "dds_lightning.rollout.result",
    "dds_lightning.metrics": "dds_lightning.nn.usage",
    "dds_lightning.run": "dds_lightning.pipeline.run",
    "dds_lightning.run_settings": "dds_lightning.pipeline.settings",
    "dds_lightning.export": "dds_lightning.sharing.export",
    "dds_lightning.verification": "dds_lightning.sharing.verify",
    "dds_lightning.envs.adapters": "dds_lightning.tasks.env",
    "dds_lightning.tasks.layout": "dds_lightning.tasks.bodies",
    "dds_lightning.training.fitting": "dds_lightning.training.stage_cli",
    "dds_lightning.callbacks.evaluation": "dds_lightning.callbacks.rollouts",
    "dds_lightning.study.baselines": "dds_lightning.baselines.behaviour_cloning",
    "dds_lightning.study.evaluation": "dds_lightning.study.evaluate",
    "dds_lightning.study.replays": "dds_lightning.study.skill_replays",
    "dds_lightning.study.atlas": "dds_lightning.study.subject",
    "dds_lightning.interpret.atlas_page": "dds_lightning.interpret.atlas.page",
    "dds_lightning.interpret.atlas_pictures": "dds_lightning.interpret.atlas.pictures",
    "datamodules.kept_codes": "datamodules.partial_codes",
    "datamodules.relabeled": "datamodules.relabelled",
    "datamodules.replay": "datamodules.physics.check",
    "datamodules.resimulate": "datamodules.physics.resimulate",
    "datamodules.sources.states": "datamodules.physics.states",
    "datamodules.sources.recordings": "datamodules.sources.rows",
    "datamodules.signature": "datamodules.sources.stat_hash",
    "datamodules.sources.belonging": "datamodules.sources.plausibility",
    "datamodules.behaviours.train": "datamodules.behaviours.training.train",
    "datamodules.behaviours.publish": "datamodules.behaviours.training.publish",
    "dds_lightning.optim": "dds_lightning.module",
    **{f"dds_lightning.interpret.{name}": f"dds_lightning.interpret.draw.{name}" for name in _DRAW},
    **{f"dds_lightning.interpret.{name}": f"dds_lightning.interpret.measure.{name}" for name in _MEASURE},
}
"""Old path of a module -> where it is now."""


class _Redirect(MetaPathFinder, Loader):
    """Answers for the old paths, after every other finder has said that it knows no such module."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return ModuleSpec(fullname, self, origin=MOVED[fullname]) if fullname in MOVED else None

    def exec_module(self, module: ModuleType) -> None:
        """Put the module of the new path in the place of the empty one that Python has made."""
        old = module.__name__
        warnings.warn(f"{old} has moved to {MOVED[old]}", DeprecationWarning, stacklevel=2)
        sys.modules[old] = import_module(MOVED[old])

    def get_code(self, fullname: str) -> CodeType | None:
        """The code of the new file, for `python -m OLD.PATH`."""
        spec = find_spec(MOVED[fullname])
        assert spec is not None
        assert isinstance(spec.loader, InspectLoader)
        return spec.loader.get_code(spec.name)


def redirect_old_paths() -> None:
    """Let the old paths be imported; harmless when repeated."""
    if not any(isinstance(finder, _Redirect) for finder in sys.meta_path):
        sys.meta_path.append(_Redirect())


def use_our_datamodules() -> None:
    """Let `import datamodules` mean ours; what ours does not have is looked for in the other one.

    Raises:
        ImportError: The other one has been imported already.
    """
    loaded = sys.modules.get(NAME)
    if loaded is not None:
        if OURS in [Path(place) for place in getattr(loaded, "__path__", ())]:
            return
        raise ImportError(
            f"{next(iter(getattr(loaded, '__path__', ())), NAME)} is another package called {NAME} than the one that "
            "dds_lightning brings, and was imported first: import dds_lightning before it, or rename it"
        )
    found = find_spec(NAME)
    others = [place for place in (found.submodule_search_locations or () if found else ()) if Path(place) != OURS]
    if found is not None and not others:
        return
    spec = spec_from_file_location(NAME, OURS / "__init__.py", submodule_search_locations=[str(OURS), *others])
    assert spec is not None, "a file has a specification"
    assert spec.loader is not None, "a source file has a loader"
    sys.modules[NAME] = module = module_from_spec(spec)
    spec.loader.exec_module(module)
