"""A local S3 server, moto's."""

import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest


@contextmanager
def s3_server() -> Iterator[None]:
    """A server with the bucket `flights`, its address in the environment as any other's would be.

    In a process of its own: in one with its clients, all would wait for the interpreter most of the time.
    """
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", "0"]
    with (
        pytest.MonkeyPatch.context() as patch,
        subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as started,
    ):
        address = next(found[0] for line in started.stderr if (found := re.findall(r"http://127\.0\.0\.1:\d+", line)))
        threading.Thread(target=started.stderr.read, daemon=True).start()  # or its log would fill the pipe
        patch.setenv("AWS_ENDPOINT_URL", address)
        patch.setenv("AWS_ACCESS_KEY_ID", "testing")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "testing")
        patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        import boto3

        boto3.client("s3").create_bucket(Bucket="flights")
        yield
        started.terminate()
