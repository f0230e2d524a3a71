"""``velfield bench``: speed and accuracy, as ratios against a peer in the same run; a file each in `velfield.bench`."""

from cyclopts import App

bench = App(name="bench", help="Measure speed and accuracy against other programs.")
bench.command(
    "flows.commands.benchmarks.speed:speed",
    name="speed",
    help="Time of each stage on one core, and of the network relative to the machine's peak.",
)
bench.command(
    "flows.commands.benchmarks.registration:registration",
    name="registration",
    help="Registration errors on simulated flights, for velfield and for stabilo.",
)
bench.command(
    "flows.commands.benchmarks.still:still",
    name="still",
    help="Registration jitter on your own footage: stability of stationary objects on the map.",
)
bench.command(
    "flows.commands.benchmarks.overhead:overhead",
    name="overhead",
    help="Overhead of Dask, and of Prefect where a server is set, over the plain functions, without start-up.",
)
bench.command(
    "flows.commands.benchmarks.field:field",
    name="field",
    help="Kernel and bins of the field with the best likelihood of held-out tracks.",
)
