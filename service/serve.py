"""`motionlabel serve`: the API in this process and the dispatcher as a child, up together and down together."""

import ipaddress
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Final

import httpx2
import typer
import uvicorn

from schemas.errors import InvalidInput
from service.app import create_app
from service.connections import bounded_protocol
from service.exit_codes import DONE, FAILURE
from service.settings import Settings
from workers.jobs.database import URL_VARIABLE, migrate_database, open_database
from workers.jobs.store import JobStore
from workers.processes import kill_session

_TICK_S: Final = 0.2
_GRACE_S: Final = 10.0  # between asking the dispatcher to end and killing it
_MAX_RESTARTS: Final = 5  # within the window; one more and there is no use in trying
_RESTART_WINDOW_S: Final = 60.0
_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def serve(
    settings: Settings,
    dispatcher_command: Sequence[str] | None = None,
    *,
    grace_s: float = _GRACE_S,
    first_delay_s: float = 0.5,
    parent_pid: int | None = None,
) -> int:
    """Run API and dispatcher until a signal says stop, the parent is gone, or the dispatcher cannot be kept alive.

    Args:
        settings: Where the store and the data are, and the address to listen on.
        dispatcher_command: What to run as the dispatcher; by default ours.
        grace_s: Seconds that the dispatcher has to end before it is killed with all its children.
        first_delay_s: Pause before the first restart of a dispatcher that died; each further one is twice as long.
        parent_pid: Of the process that must not be outlived; None: there is none.

    Returns:
        Exit code: 0 when a signal or the parent's end said stop, 1 when the dispatcher died too often.

    Raises:
        InvalidInput: The address cannot be listened on, or not without API keys, or the data folder, the job store or
            the keys cannot be used.

    """
    _require_keys(settings)
    _make_folder(settings.data_dir)
    _prepare_store(settings)
    with _listen(settings) as listener, _Stop(parent_pid) as stop, _running_api(settings, listener) as api:
        command = dispatcher_command or _default_command(settings)
        dispatcher = _Dispatcher(command, {URL_VARIABLE: settings.store_url}, grace_s, first_delay_s)
        url = _url(listener)
        is_announced = False
        try:
            while not stop.is_asked and api.is_alive() and dispatcher.keep_alive():
                if not is_announced and _is_ready(url, settings, dispatcher.pid):
                    roots = ", ".join(settings.data_roots)
                    typer.echo(f"motionlabel serves {url} (data under {roots}; Ctrl-C stops it)")
                    is_announced = True
                time.sleep(_TICK_S)
            if not api.is_alive() and not stop.is_asked:
                _say("the API ended by itself: what it said stands above")
        finally:
            dispatcher.stop()
    return DONE if stop.is_asked else FAILURE


def _default_command(settings: Settings) -> list[str]:
    command = [sys.executable, "-P", "-m", "workers.dispatcher"]  # -P: modules of this folder stay out
    command += ["--data-dir", str(settings.data_dir), "--parent-pid", str(os.getpid())]
    return command + (["--ray-address", settings.ray_address] if settings.ray_address else [])


def _prepare_store(settings: Settings) -> None:
    """Say what is wrong with the store before anything starts. One of our own is migrated: nobody else uses it."""
    if settings.database_url:
        open_database(settings.store_url).close()
        return
    migration = migrate_database(settings.store_url)
    if migration.is_upgrade:
        _say(migration.describe())


def _require_keys(settings: Settings) -> None:
    """Let nobody in from another machine who is not asked for a key."""
    if settings.api_keys_file is None and not _is_loopback(settings.host):
        raise InvalidInput(
            f"listening on {settings.host} lets other machines in: make a key with `motionlabel key new --owner NAME "
            "--scope submit --file FILE` and start with --api-keys FILE, or listen on 127.0.0.1"
        )


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"  # where another name leads is for others to say


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInput(f"cannot make data folder {folder}: {error.strerror}; choose another --data-dir") from None


def _listen(settings: Settings) -> socket.socket:
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    try:
        return socket.create_server((settings.host, settings.port), family=family)
    except OSError as error:
        place = f"{settings.host}:{settings.port}"
        reason = os.strerror(error.errno) if error.errno and error.errno > 0 else error.strerror  # in short
        raise InvalidInput(f"cannot listen on {place}: {reason}; choose another --host or --port") from None


def _url(listener: socket.socket) -> str:
    host, port = listener.getsockname()[:2]
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)  # whom to call, not where to listen
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


@contextmanager
def _running_api(settings: Settings, listener: socket.socket) -> Iterator[threading.Thread]:
    app = create_app(settings)
    config = uvicorn.Config(
        app, http=bounded_protocol(), log_level="warning", lifespan="on", timeout_graceful_shutdown=5
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, name="api")  # signals stay with us
    thread.start()
    try:
        yield thread
    finally:
        app.state.streams.close()
        server.should_exit = True
        thread.join()


def _is_ready(url: str, settings: Settings, dispatcher_pid: int | None) -> bool:
    """Return whether the API answers and our dispatcher, not one that ran here before, has reported to the store."""
    try:
        if not httpx2.get(f"{url}/readyz", timeout=2.0, trust_env=False).is_success:
            return False
    except httpx2.HTTPError:
        return False
    with closing(open_database(settings.store_url)) as database:
        return dispatcher_pid in [dispatcher.pid for dispatcher in JobStore(database).status().dispatchers]


def _say(message: str) -> None:
    typer.echo(f"motionlabel: {message}", err=True)


class _Stop:
    """Notes signals and the end of the parent. The handlers only set a flag: the main loop looks at it."""

    def __init__(self, parent_pid: int | None) -> None:
        self._parent_pid = parent_pid
        self._is_signalled = False

    @property
    def is_asked(self) -> bool:
        """True when it is time to end. An orphan's parent is another process, whoever adopts it."""
        return self._is_signalled or self._parent_pid not in (None, os.getppid())

    def __enter__(self) -> "_Stop":
        heard = [
            number for number in _SIGNALS if signal.getsignal(number) is not signal.SIG_IGN
        ]  # nohup's stay ignored
        self._previous = {number: signal.signal(number, self._note) for number in heard}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _note(self, *_: object) -> None:
        self._is_signalled = True


class _Dispatcher:
    """The child process, started again when it dies; in a session of its own, so that nothing of it is left behind."""

    def __init__(
        self, command: Sequence[str], variables: Mapping[str, str], grace_s: float, first_delay_s: float
    ) -> None:
        self._command = list(command)
        self._environment = os.environ | variables
        self._grace_s = grace_s
        self._first_delay_s = first_delay_s
        self._restarts_s: deque[float] = deque(maxlen=_MAX_RESTARTS)
        self._start_at_s = time.monotonic()
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def pid(self) -> int | None:
        """None between two starts."""
        return None if self._process is None else self._process.pid

    def keep_alive(self) -> bool:
        """Start it when it is due; return False when it died too often to try again."""
        now_s = time.monotonic()
        if self._process is None:
            if now_s >= self._start_at_s:
                # Ctrl-C goes to all of a terminal's session: in its own, the dispatcher hears of it from us, once.
                self._process = subprocess.Popen(
                    self._command, env=self._environment, stdin=subprocess.DEVNULL, start_new_session=True
                )
            return True
        code = self._process.poll()
        if code is None:
            return True
        kill_session(self._process.pid)
        self._process = None
        recent = [at_s for at_s in self._restarts_s if at_s > now_s - _RESTART_WINDOW_S]
        if len(recent) == _MAX_RESTARTS:
            _say(f"the dispatcher ended {_MAX_RESTARTS + 1} times within a minute (last exit code {code}): giving up")
            return False
        delay_s = self._first_delay_s * 2 ** len(recent)
        _say(f"the dispatcher ended with exit code {code}: starting it again in {delay_s:g} s")
        self._restarts_s.append(now_s)
        self._start_at_s = now_s + delay_s
        return True

    def stop(self) -> None:
        """Ask it to end, wait, and kill whatever of its session is left."""
        if self._process is None:
            return
        self._process.terminate()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(self._grace_s)
        kill_session(self._process.pid)
        self._process.wait()
