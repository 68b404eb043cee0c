"""Runs commands on a cluster of two nodes on this machine, whose workers get killed.

    python ray_cluster.py KILLS COMMAND ARGUMENT ...

A process of its own: Ray starts others and sets signals. Prints how many workers were
killed, and leaves with the command's status.
"""

import os
import random
import signal
import subprocess
import sys
import threading
import time

from ray.cluster_utils import Cluster

from unips_jax.cli import main


def workers():
    """Processes that are at a task."""
    found = subprocess.run(
        ["pgrep", "-f", "^ray::_attempt"], capture_output=True, text=True
    )
    return [int(pid) for pid in found.stdout.split()]


def kill_some(count, killed, over):
    seen = random.Random(0)
    while len(killed) < count and not over.is_set():
        running = workers()
        if not running:
            time.sleep(0.05)
            continue
        time.sleep(seen.uniform(0, 1.5))  # at any moment of its work
        victim = seen.choice(running)
        try:
            os.kill(victim, signal.SIGKILL)
        except ProcessLookupError:
            continue
        killed.append(victim)
        time.sleep(0.5)


if __name__ == "__main__":
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    cluster.add_node(num_cpus=1)
    killed, over = [], threading.Event()
    killer = threading.Thread(target=kill_some, args=(int(sys.argv[1]), killed, over))
    killer.start()
    where = ["--ray", cluster.address, "--ray-cores", "1"]
    status = main.main([*sys.argv[2:], *where])
    over.set()
    killer.join()
    cluster.shutdown()
    print(f"killed {len(killed)}")
    sys.exit(status)
