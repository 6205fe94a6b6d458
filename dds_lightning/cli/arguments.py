"""Arguments that several commands share, and how they are read."""

from dds_lightning.errors import UserError
from dds_lightning.saving.files import expand


def data_spec(data: str) -> str:
    """Accept a folder or a file where a source is obvious.

    Args:
        data: `SOURCE:NAME`, or a path: a folder of arrays, a Minari folder, or an HDF5 file in D4RL's layout.

    Raises:
        UserError: There is no source and no such path.
    """
    path = expand(data)
    if path.is_dir():
        return f"{'arrays' if (path / 'trajectories.json').is_file() else 'local'}:{data}"
    if path.suffix in (".hdf5", ".h5") and path.is_file():
        return f"d4rl:{data}"
    if ":" not in data:
        from datamodules.sources import SOURCES

        kinds = ", ".join(f"{name}:{source.rest}" for name, source in SOURCES.items())
        if path.is_file():
            raise UserError(f"data: {data!r} is a file that does not end in .hdf5; say what it is, by one of {kinds}")
        raise UserError(f"data: there is no folder or .hdf5 file {data!r}; give one, or one of {kinds}")
    return data
