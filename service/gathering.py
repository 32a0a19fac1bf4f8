"""One call for all questions that come while the last call is under way."""

from __future__ import annotations

import asyncio
import contextvars
from collections.abc import Callable, Mapping
from typing import Generic, TypeVar

import anyio
import anyio.to_thread

Question = TypeVar("Question")
"""What is asked; hashable."""
Answer = TypeVar("Answer")
"""What is answered."""


class Gathered(Generic[Question, Answer]):
    """Answers questions together, in one thread: the more there are, the less each costs.

    One that comes during a call is part of the next. After a call for several questions the next waits a moment for
    more of them; after one for a single question it waits for nothing.

    Parameters
    ----------
    answer : callable
        The answers to a set of questions; those without one are left out. An exception as an answer is raised for its
        question, one that the call itself raises for all of them.
    moment_s : float
        Seconds for which a call waits if the last one answered several questions.
    """

    def __init__(
        self, answer: Callable[[set[Question]], Mapping[Question, Answer | Exception]], *, moment_s: float = 0.0
    ) -> None:
        self._answer = answer
        self._moment_s = moment_s
        self._last = 0
        self._waiting: list[tuple[Question, asyncio.Future[Answer | None]]] = []
        self._one_call = anyio.CapacityLimiter(1)
        self._task: asyncio.Task[None] | None = None

    async def ask(self, question: Question) -> Answer | None:
        """The answer to one question, None if there is none; raises the exception that is its answer."""
        answered: asyncio.Future[Answer | None] = asyncio.get_running_loop().create_future()
        self._waiting.append((question, answered))
        if self._task is None or self._task.done():
            # not in the context of this question, such as the trace of its request: the task answers others, too
            self._task = asyncio.create_task(self._answer_all(), context=contextvars.Context())
        return await answered

    async def _answer_all(self) -> None:
        while self._waiting:
            if self._last > 1:
                await asyncio.sleep(self._moment_s)
            # those who no longer want an answer have cancelled theirs
            asked = [(question, answered) for question, answered in self._waiting if not answered.done()]
            self._waiting, self._last = [], len(asked)
            questions = {question for question, _ in asked}
            answers: Mapping[Question, Answer | Exception]
            try:
                answers = await anyio.to_thread.run_sync(self._answer, questions, limiter=self._one_call)
            except Exception as error:  # noqa: BLE001 - each of those who ask gets it
                answers = dict.fromkeys(questions, error)
            for question, answered in asked:
                answer = answers.get(question)
                if answered.done():
                    continue
                if isinstance(answer, Exception):
                    answered.set_exception(answer)
                else:
                    answered.set_result(answer)
