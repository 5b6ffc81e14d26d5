"""Makes the paper's tables: every system trained, exported, and run by the same runtime, from one file: `python -m lads_exporter table
TABLE.toml`.

| module | what |
|---|---|
| definition | the table's file: splits, how is evaluated, tracks, systems with the paper's numbers |
| jobs | one system and seed in one track: train, export, evaluate; what is finished is kept by the hash of its inputs |
| commands | the steps of a job, with all files that each reads and writes |
| local, on_ray | the engines that run them: this machine; a Ray cluster |
| node, shards | what runs on a node of a cluster; an evaluation put together from its parts |
| run | all jobs of a table, some at a time; the numbers of finished ones |
| render | models/tables.json and models/TABLES.md |

A *track* is a base configuration for all systems; two tracks never share a row. A table can be interrupted at any time: the same command goes on.
"""
