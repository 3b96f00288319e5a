"""A stand-in for Slurm on this machine: `sbatch`, `srun`, `sacct` and `scancel`, by the name it is called with. Jobs start at once."""

import os
import pathlib
import re
import subprocess
import sys

STATES = pathlib.Path(os.environ["FAKE_SLURM"])  # a file for each job, its state inside


def sbatch(script):
    text = pathlib.Path(script).read_text()
    number = str(1000 + len(list(STATES.glob("*.sh"))))
    (STATES / f"{number}.sh").write_text(text)
    array = re.search(r"#SBATCH --array=0-(\d+)", text)
    for name in [f"{number}_{k}" for k in range(int(array[1]) + 1)] if array else [number]:
        (STATES / name).write_text("RUNNING")
        command = [sys.executable, pathlib.Path(__file__).with_name("fake_slurm.py"), "job", name, script]
        subprocess.Popen(command, start_new_session=True, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    print(f"Submitted batch job {number}")


def job(name, script):
    """Run a job to its end; `sbatch` starts it."""
    number, _, index = name.partition("_")
    more = {"SLURM_ARRAY_JOB_ID": number, "SLURM_ARRAY_TASK_ID": index} if index else {}
    done = subprocess.run(["bash", script], env={**os.environ, "SLURM_JOB_ID": number, **more}, check=False)
    (STATES / name).write_text("FAILED" if done.returncode else "COMPLETED")


def srun(_, out_flag, out, error_flag, error, *command):
    assert (out_flag, error_flag) == ("--output", "--error")
    names = {"%j": "SLURM_JOB_ID", "%A": "SLURM_ARRAY_JOB_ID", "%a": "SLURM_ARRAY_TASK_ID"}
    for short, name in names.items():
        out, error = (path.replace(short, os.environ.get(name, "")) for path in (out, error))
    with open(out.replace("%t", "0"), "a") as said, open(error.replace("%t", "0"), "a") as wrong:
        sys.exit(1 if subprocess.run(command, stdout=said, stderr=wrong, check=False).returncode else 0)


def sacct(*_):
    print("JobID|State|NodeList")
    for path in sorted(STATES.iterdir()):
        if path.suffix != ".sh":
            print(f"{path.name}|{path.read_text()}|here")


def scancel(*_):
    sys.exit("nothing is to be cancelled here")


if __name__ == "__main__":
    called, *arguments = [pathlib.Path(sys.argv[0]).name, *sys.argv[1:]]
    if called == "fake_slurm.py":
        called, *arguments = arguments
    {function.__name__: function for function in (sbatch, job, srun, sacct, scancel)}[called](*arguments)
