"""``velfield serve``: process flights and base images that arrive in a folder, with the Prefect UI."""

from contextlib import suppress
from pathlib import Path


def serve(
    folder: Path = Path("velfield-serve"),
    /,
    *,
    host: str = "127.0.0.1",
    port: int = 4200,
    database: str | None = None,
    auth: str | None = None,
    nightly: str = "0 3 * * *",
    settle_s: float = 10.0,
    limit: int = 1,
    cluster: Path | None = None,
) -> int:
    """Process flights and base images that arrive in a folder, with the Prefect UI, until Ctrl-C.

    Drop flights into FOLDER/incoming and base images into FOLDER/base-images; runs are written to FOLDER/runs. The
    event `velfield.base-image.arrived` with `base` (and `run`) in its payload starts a reprocess, as does --nightly.

    Parameters
    ----------
    folder
        Folder of incoming files and of the runs.
    host
        Address to serve on. Any address that other machines can reach needs `--auth`.
    port
        Port of the server and its UI.
    database
        `postgresql+asyncpg://...`. Default: SQLite in FOLDER.
    auth
        USER:PASSWORD required by the server.
    nightly
        Cron expression of the nightly reprocess.
    settle_s
        Seconds without a change after which a file counts as complete.
    limit
        Number of flow runs at a time.
    cluster
        Cluster file, as for `velfield run`.
    """
    from flows.launch import prepare_process, spare_proxies

    spare_proxies()
    prepare_process(verbose=False)
    from flows.serve import ServeConfig, serve_folder

    config = ServeConfig(
        folder=folder.resolve(),
        host=host,
        port=port,
        database=database,
        auth=auth,
        nightly=nightly,
        settle_s=settle_s,
        limit=limit,
        cluster=str(cluster.resolve()) if cluster else "",
    )
    with suppress(KeyboardInterrupt):
        serve_folder(config)
    print("stopped; all processes ended")
    return 0
