"""Who does numbered jobs: processes of this machine, or a cluster.

- executor: what an executor is, the one of this machine, and the choice between the two
- dask_cluster: the workers of a Dask scheduler
- output: where jobs leave their files: a folder, or an object store
- worker_check: whether a worker of a cluster can do jobs as this machine does
"""
