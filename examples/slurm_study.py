"""Run a study on a SLURM cluster: `python slurm_study.py STUDY.toml FOLDER [JOBS]` on a node that can submit jobs.

It needs `pip install "ctr_nlp[study]" dask-jobqueue cryptography`, in an environment that the nodes see, too.
Start it again with the same folder to resume it.
"""

import sys
from pathlib import Path

from dask_jobqueue import SLURMCluster
from distributed import Client, Security

import ctr_nlp as ctr


def slurm_cluster() -> SLURMCluster:
    """Return a cluster of one-process jobs, none submitted yet. Change partition, memory and time."""
    return SLURMCluster(
        queue="normal",  # the partition
        cores=1,
        processes=1,  # a job of several is not submitted again when it dies
        memory="2GiB",
        walltime="04:00:00",
        worker_extra_args=["--lifetime", "220m", "--lifetime-stagger", "10m"],  # leave before SLURM ends the job
        job_script_prologue=[
            *("export OMP_NUM_THREADS=1", "export OPENBLAS_NUM_THREADS=1"),
            # otherwise workers return memory to the system after every step, which takes much time
            *("export MALLOC_TRIM_THRESHOLD_=268435456", "export MALLOC_MMAP_THRESHOLD_=33554432"),
        ],
        protocol="tls",  # nodes are shared: without TLS, whoever reaches the scheduler's port runs code as you
        security=Security.temporary(),  # certificates of this run alone, in files that only you can read
        shared_temp_directory="~",  # where the nodes see these files
        scheduler_options={"dashboard_address": "127.0.0.1:0"},  # look at it through an ssh tunnel
    )


if __name__ == "__main__":
    study, folder = ctr.Study.from_toml(sys.argv[1]), Path(sys.argv[2])
    with slurm_cluster() as cluster, Client(cluster) as client:
        jobs = int(sys.argv[3]) if len(sys.argv) > 3 else 8
        cluster.adapt(minimum_jobs=jobs, maximum_jobs=jobs)  # jobs that end are submitted again
        ctr.run_study(
            study,
            folder,
            client,
            callback=lambda progress: print(f"{progress.done} of {progress.total}", flush=True),
        )
    print(ctr.Results(folder).frame().groupby("problem")["e3"].describe())
