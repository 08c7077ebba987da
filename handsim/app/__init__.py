"""What commands share: what they say, how they end, and who does their work.

- messages: lines as they are, warnings as lines, and a line of status that is renewed in place
- progress: the progress bar of all commands, and lines in its place in a log
- interrupts: signals to end, as a flag that a loop reads or as an exception
- workers: numbered jobs in processes of this machine, or on another executor
- cluster: the workers of a Dask scheduler as an executor
- output: where jobs leave their files, a folder or an object store
- page: one HTML page of pictures and figures
"""
