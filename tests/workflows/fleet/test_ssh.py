"""A fleet by ssh: a server of asyncssh's in this process, on 127.0.0.1 with keys of its own, starts Dask's scheduler and a worker."""

import asyncio
import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from tests.workflows.command import Enerf
from tests.workflows.fleet.fleets import fleet_json, toy_manifest

pytest.importorskip("distributed", reason="Dask distributed (the extra fleet) is not installed")
asyncssh: Any = pytest.importorskip("asyncssh", reason="asyncssh (the extra fleet) is not installed: no fleet is run by ssh")


@dataclass
class Server:
    """What clients asked it to run, and the processes that did."""

    port: int = 0
    users: list[str] = field(default_factory=list)
    commands: list[str] = field(default_factory=list)
    processes: list[asyncio.subprocess.Process] = field(default_factory=list)

    async def run(self, process: Any) -> None:
        """As a real one does it: by a shell, in a group of processes that gets the client's signals and ends with the connection."""
        pipe = asyncio.subprocess.PIPE
        child = await asyncio.create_subprocess_shell(process.command, stdin=asyncio.subprocess.DEVNULL, stdout=pipe, stderr=pipe, start_new_session=True)
        self.users.append(process.get_extra_info("username"))
        self.commands.append(process.command)
        self.processes.append(child)
        await process.redirect(stdout=child.stdout, stderr=child.stderr)
        ended, closed = asyncio.ensure_future(child.wait()), asyncio.ensure_future(process.channel.wait_closed())
        await asyncio.wait({ended, closed}, return_when=asyncio.FIRST_COMPLETED)
        if ended.done():
            process.exit(child.returncode)
        else:
            kill(child)
        await ended

    async def serve(self, host_key: Any, clients: Path, started: threading.Event, over: asyncio.Event) -> None:
        server = await asyncssh.listen(
            "127.0.0.1", 0, server_host_keys=[host_key], authorized_client_keys=str(clients), process_factory=self.run, password_auth=False
        )
        self.port = server.get_port()
        started.set()
        await over.wait()
        server.close()
        for child in self.processes:
            kill(child)
        await asyncio.gather(*(child.wait() for child in self.processes))
        for child in self.processes:
            child._transport.close()  # type: ignore[attr-defined]  # else each warns once it is collected


def kill(child: asyncio.subprocess.Process) -> None:
    if child.returncode is None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    """Takes one key, and is known by another: `client_key` and `known_hosts` in the test's folder."""
    host_key, client_key = (asyncssh.generate_private_key("ssh-ed25519") for _ in range(2))
    client_key.write_private_key(str(tmp_path / "client_key"))
    client_key.write_public_key(str(tmp_path / "authorized_keys"))
    found, started, loops = Server(), threading.Event(), []

    def serve() -> None:
        async def main() -> None:
            over = asyncio.Event()
            loops.append((asyncio.get_running_loop(), over))
            await found.serve(host_key, tmp_path / "authorized_keys", started, over)

        asyncio.run(main())

    thread = threading.Thread(target=serve, name="ssh server")
    thread.start()
    assert started.wait(20.0)
    host_key.write_public_key(str(tmp_path / "host_key.pub"))
    public = (tmp_path / "host_key.pub").read_text(encoding="ascii")
    (tmp_path / "known_hosts").write_text(f"[127.0.0.1]:{found.port} {public}", encoding="ascii")
    yield found
    loop, over = loops[0]
    loop.call_soon_threadsafe(over.set)
    thread.join(20.0)
    assert not thread.is_alive()


def options(folder: Path, port: int, key: str = "client_key") -> Path:
    """One worker without a process that watches it; the scheduler looks for no free port of its own for a dashboard."""
    path = folder / "ssh.toml"
    path.write_text(
        f"""hosts = ["127.0.0.1", "127.0.0.1"]
worker_class = "distributed.Worker"

[connect_options]
port = {port}
username = "operator"
client_keys = ["{folder / key}"]
known_hosts = "{folder / "known_hosts"}"
config = []
agent_path = ""

[worker_options]
nthreads = 2
dashboard_address = ""

[scheduler_options]
host = "127.0.0.1"
port = 0
dashboard = false
""",
        encoding="utf-8",
    )
    return path


def test_a_fleet_runs_on_workers_that_ssh_starts(enerf: Enerf, toys: Path, server: Server, tmp_path: Path) -> None:
    fleet = tmp_path / "fleet"
    chosen = options(tmp_path, server.port)
    result = enerf("fleet", toy_manifest(tmp_path, 2), "--out", fleet, "--jobs", 2, "--cluster", "ssh", "--cluster-options", chosen, "--json")
    assert result.code == 0, result.err
    found = fleet_json(fleet)
    assert (found["state"], found["executor"], found["totals"]["done"]) == ("done", "dask", 2)
    assert {stage["worker"].startswith("tcp://127.0.0.1:") for scene in found["scenes"] for stage in scene["stages"].values()} == {True}
    started = [command for command in server.commands if "dask_spec" in command]
    assert ["distributed.Scheduler" in command for command in started] == [True, False]
    assert set(server.users) == {"operator"}
    assert all((fleet / scene["name"] / "train" / "field.txt").is_file() for scene in found["scenes"])
