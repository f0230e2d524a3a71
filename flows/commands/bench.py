"""``velfield bench``: speed and accuracy, as ratios against a peer in the same run; a file each in `velfield.bench`."""

from cyclopts import App

bench = App(name="bench", help="Speed and accuracy, against a peer in the same run.")
bench.command(
    "flows.commands.benchmarks.speed:speed",
    name="speed",
    help="What each stage of the whole job costs on one core, and the network against the machine's peak.",
)
bench.command(
    "flows.commands.benchmarks.registration:registration",
    name="registration",
    help="Register simulated flights of unseen seeds: errors against the truth, beside stabilo.",
)
bench.command(
    "flows.commands.benchmarks.still:still",
    name="still",
    help="Stability of stationary objects on a run's map: registration jitter, on your own footage.",
)
bench.command(
    "flows.commands.benchmarks.overhead:overhead",
    name="overhead",
    help="What Prefect and Dask add to the bare functions, start-up left out.",
)
bench.command(
    "flows.commands.benchmarks.field:field",
    name="field",
    help="Kernel and bins of the field with the best likelihood of held-out tracks.",
)
bench.command(
    "flows.commands.benchmarks.detection:detection",
    name="detection",
    help="How fast cars are found, beside plain peers in the same run.",
)
