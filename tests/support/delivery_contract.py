"""What the store writes together with the thing that a request makes, on every database."""

import dataclasses
from concurrent.futures import ThreadPoolExecutor
from uuid import uuid4

import pytest
from store_contract import HOUR_S, DatabaseContract, ids, request, upload

from service.deliveries import Claim, Delivery, StoredAnswer
from service.errors import KeyInUseError, QuotaError
from service.jobs import Job
from service.store import JobStore


class DeliveryContract(DatabaseContract):
    """Uploads, and the answer under the key of a request."""

    def test_of_many_requests_with_one_key_one_holds_it(self, store: JobStore) -> None:
        claims = [Claim(owner="o", key="k") for _ in range(8)]

        def claimed(claim: Claim) -> bool:
            try:
                return store.claim_key(claim) is None
            except KeyInUseError:
                return False

        with ThreadPoolExecutor(len(claims)) as crew:
            assert sorted(crew.map(claimed, claims)) == [False] * 7 + [True]
        assert store.claim_key(Claim(owner="other", key="k")) is None

    def test_a_job_and_the_answer_about_it_are_kept_together_or_not_at_all(self, store: JobStore) -> None:
        def answer(job: Job) -> StoredAnswer:
            headers = {"location": f"/jobs/{job.job_id}"}
            return StoredAnswer(fingerprint="f" * 64, size_bytes=5, status=201, headers=headers, body="{}")

        first, second = Claim(owner="", key="k"), Claim(owner="", key="k")
        assert store.claim_key(first) is None

        def create(claim: Claim) -> Job:
            delivery = Delivery(claim=claim, answer=answer, kept_s=HOUR_S)
            return store.create(request(), owner=None, delivery=delivery)

        with pytest.raises(KeyInUseError):
            create(second)
        assert ids(store) == set()
        assert store.answer_to("", "k") is None
        job = create(first)
        kept = store.claim_key(second)
        assert kept == store.answer_to("", "k") == answer(job)
        store.drop_claim(first)
        assert store.answer_to("", "k") == kept
        assert store.answer_to("other", "k") is None

    def test_uploads_of_one_key_have_a_limit_together_also_if_they_come_at_once(self, store: JobStore) -> None:
        size = upload(store, owner="k").size_bytes
        upload(store, owner="other")
        one = dataclasses.replace(upload(store, owner="k"), upload_id="")
        assert store.stored_bytes("k") == 2 * size
        assert store.stored_bytes(None) == 0

        def add(_number: int) -> bool:
            added = dataclasses.replace(one, upload_id=uuid4().hex)
            try:
                store.add_uploads(Delivery(uploads=(added,), max_upload_bytes=4 * size))
            except QuotaError as error:
                assert str(4 * size) in str(error)  # noqa: PT017 - the number of errors counts, too
                return False
            return True

        with ThreadPoolExecutor(6) as crew:
            assert sum(crew.map(add, range(6))) == 2
        assert store.stored_bytes("k") == 4 * size
