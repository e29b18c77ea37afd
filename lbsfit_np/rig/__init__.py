"""The rig: its one immutable type, how it is built and checked, its card, partitions, joint regressor and proportions."""
