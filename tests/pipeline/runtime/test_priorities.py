"""Interactive runs overtake batch runs, whatever either of them wishes."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import chores
import pytest
from distributed import Client
from processes import LONG_S, wait_for

from pipeline.runtime.cluster.dask_executor import Cluster
from pipeline.runtime.cluster.priorities import PRIORITIES, Traffic, priority_of
from pipeline.runtime.monitoring.progress import Watch


def test_no_wish_leads_out_of_the_kind_of_a_run() -> None:
    order: list[Traffic] = ["batch", "interactive"]
    assert sorted(PRIORITIES, key=lambda name: PRIORITIES[name]) == order
    wishes = (-(10**12), -1, 0, 1, 10**12)
    found = [[priority_of(traffic, wish) for wish in wishes] for traffic in order]
    assert found == [sorted(some) for some in found]
    assert max(found[0]) < min(found[1])


def test_an_interactive_run_overtakes_the_tasks_of_a_batch_run_that_wait(tmp_path: Path) -> None:
    def go(cluster: Cluster, name: Traffic, wish: int, count: int) -> None:
        with cluster.executor(wish, traffic=name) as executor:
            tasks = [(str(tmp_path), f"{name}{k}") for k in range(count)]
            results = [measured.result for measured in executor.map(name, chores.wait_for_mark, tasks, Watch())]
        assert len(results) == count

    def started() -> list[str]:
        return [path.name.split("-")[2] for path in sorted(tmp_path.glob("started-*"))]

    with Cluster(workers=1) as cluster, ThreadPoolExecutor(2) as threads, Client(cluster._embedded) as client:

        def known() -> int:
            return client.run_on_scheduler(lambda dask_scheduler: len(dask_scheduler.tasks))

        # more than the window of a run: six of them wait on the cluster
        batch = threads.submit(go, cluster, "batch", 1000, 12)
        interactive = None
        try:
            wait_for(lambda: known() == 6 and started(), "a batch run whose tasks wait")
            interactive = threads.submit(go, cluster, "interactive", -1000, 3)
            wait_for(lambda: known() == 9, "the tasks of the interactive run")
        finally:
            Path(tmp_path, "go").touch()
        interactive.result(LONG_S)
        batch.result(LONG_S)
    order = [name.rstrip("0123456789") for name in started()]
    # of the twelve one ran, and one may have been at the worker already; the others had to let all three pass
    assert (
        sorted(order[:5]) == ["batch"] * 2 + ["interactive"] * 3 or sorted(order[:4]) == ["batch"] + ["interactive"] * 3
    )
    assert order.count("batch") == 12


@pytest.mark.parametrize(("wish", "expected"), [(0, 0), (7, 7), (-3, -3)])
def test_the_service_asks_for_interactive_traffic(wish: int, expected: int) -> None:
    # what `service.driver.attempt` calls, with a job's priority
    executor = Cluster(scheduler="tcp://127.0.0.1:9").executor(wish)
    assert executor._priority == expected > PRIORITIES["batch"]
