"""``velfield config``: the configuration of a run."""

from cyclopts import App

from flows.options import RunFolder

config = App(name="config", help="Print the configuration of a run.")


@config.command
def show(run_folder: RunFolder, /) -> int:
    """Print the resolved configuration of a run as YAML; `velfield run ... --config FILE` reads it back."""
    import yaml

    from velfield.run.run import open_run

    record = open_run(run_folder).record
    print(f"# made by velfield {record.code_version} from {record.inputs.source.path}")
    print(yaml.safe_dump(record.config.model_dump(mode="json"), sort_keys=False), end="")
    return 0
