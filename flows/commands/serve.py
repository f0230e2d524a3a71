"""``velfield serve``: flights and base images that arrive in a folder are processed, seen in the Prefect UI."""

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
    """A Prefect server with its UI; process what arrives, reprocess when a new base image does. Ctrl-C ends all of it.

    Drop flights into FOLDER/incoming and base images into FOLDER/base-images; the runs are in FOLDER/runs. The event
    `velfield.base-image.arrived` with `base` (and `run`) in its payload starts a reprocess too, and so does the night.

    Parameters
    ----------
    folder
        Folder of what arrives and what is made of it.
    host
        Address to serve on. Another than this machine's own needs `--auth`.
    port
        Port of the server and its UI.
    database
        `postgresql+asyncpg://...` in place of SQLite.
    auth
        USER:PASSWORD that the server asks for.
    nightly
        Cron expression of the nightly reprocess.
    settle_s
        What has not changed for so many seconds has arrived whole.
    limit
        Flow runs at a time.
    cluster
        File that says where to compute, as for `velfield run`.
    """
    from flows.launch import prepare_process

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
    try:
        serve_folder(config)
    except KeyboardInterrupt:
        print("stopped; nothing of it is running any more")
    return 0
