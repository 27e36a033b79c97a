"""`ugr replay`: execute recorded commands again."""

from functools import partial
from pathlib import Path

from ugr_lightning.cli.parsing.call import call
from ugr_lightning.errors import DataError


def _replay(path: str, workers: int = 2) -> int:
    """Execute the commands of recorded episodes again; exit code 2 where one does not succeed again.

    Args:
        path: an episode of `ugr collect`, or a folder `<root>/<task>/<setting>` of them.
        workers: simulator processes.
    """
    from ugr_lightning.data.folder import find_episodes
    from ugr_lightning.demos.replay import replay

    place = Path(path)
    episodes = list(find_episodes(place).values()) if place.is_dir() else [place]
    if not episodes:
        raise DataError(place, "a folder with data/episode<i>.hdf5", "none there", "Record with `ugr collect`.")
    results = replay(episodes, workers=workers)
    failed = [item for item in results if not item.success]
    for item in failed if len(results) > 1 else results:
        print(item)
    identical = sum(item.identical for item in results)
    largest = max(item.deviation for item in results)
    n = len(results)
    print(f"{n - len(failed)} of {n} reproduced their success, {identical} of {n} with the same joints bit for bit")
    print(f"largest deviation of a joint: {largest:.3g} rad")
    return 2 if failed else 0


run = partial(call, _replay, leading=["path"])
