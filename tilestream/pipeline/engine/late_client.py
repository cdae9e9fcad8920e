"""A Dask client that is made when there is work for it: where all is done, no worker is started."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import Any, Self


class LateClient:
    """A client of workers of our own, which are started when there are tasks for them."""

    def __init__(self, most: int, start: Callable[[int], AbstractContextManager[Any]]) -> None:
        """Nothing is started yet.

        Args:
            most: how many workers there may be.
            start: starts so many, and gives a client of their cluster.
        """
        self.most = most
        self.when_made: list[Callable[[Any], object]] = []
        """What the client is told to as soon as it is made."""
        self._start = start
        self._client: Any = None
        self._stack = ExitStack()

    def for_tasks(self, count: int) -> Any:
        """The Dask client, with a worker for each of so many tasks, as far as there may be so many.

        The first who asks decides: a cluster that grows while it is closed may never end.

        Raises:
            TaskError, UsageError: no worker can be started.
        """
        if self._client is None:
            self._client = self._stack.enter_context(self._start(min(count, self.most)))
            for begin in self.when_made:
                begin(self._client)
        return self._client

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: Any) -> None:
        """End the workers, if any were started."""
        self._stack.__exit__(*error)


def client_for(client: Any, count: int) -> Any:
    """The Dask client that so many tasks run on: what is late is made now (`LateClient`)."""
    return client.for_tasks(count) if isinstance(client, LateClient) else client


@contextmanager
def around(
    client: Any | None, inside: Callable[[Any], AbstractContextManager[object]]
) -> Iterator[None]:
    """Have something around the work of a client: it begins now, or when the client is made.

    Args:
        client: a Dask client, a late one, or None, around whose work there is nothing.
        inside: makes what is to be around it.
    """
    with ExitStack() as stack:

        def begin(made: Any) -> None:
            stack.enter_context(inside(made))

        if isinstance(client, LateClient):
            client.when_made.append(begin)
            stack.callback(client.when_made.remove, begin)
        elif client is not None:
            begin(client)
        yield
