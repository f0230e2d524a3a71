"""The commands of `velfield`, one file each, imported when they run."""
