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
        raise UserError(
            f"data: there is no folder or .hdf5 file {data!r}; give one, or local:DIR, minari:ID, d4rl:FILE or "
            "arrays:DIR"
        )
    return data
