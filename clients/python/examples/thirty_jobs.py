"""Solves files of tracks from five coroutines. A server that crashes and comes back loses no job and doubles none."""

import asyncio
import sys

import scpsfm


async def worker(client: scpsfm.AsyncClient, paths: list[str], results: dict[str, scpsfm.Result]) -> None:
    while paths:
        path = paths.pop()
        tracks = scpsfm.Tracks.from_csv(path, width=1200, height=900)
        job = await client.submit(tracks, labels={"file": path})
        results[path] = await job.result()


async def main(address: str, *paths: str) -> None:
    waiting, results = list(paths), dict[str, scpsfm.Result]()
    async with scpsfm.AsyncClient(address, retry=scpsfm.RetryPolicy(patience_s=120)) as client:
        await asyncio.gather(*(worker(client, waiting, results) for _ in range(5)))
    for path, result in sorted(results.items()):
        print(path, result.grade, result.focal_px)


asyncio.run(main(*sys.argv[1:]))
