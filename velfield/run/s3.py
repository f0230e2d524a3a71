"""Paths on S3: universal-pathlib's, with the four operations where it makes several requests or writes in parts.

The store's address and credentials come from the environment, as for every program that speaks S3:
``AWS_ENDPOINT_URL``, ``AWS_ACCESS_KEY_ID``, ...
"""

from typing import Any

from upath.extensions import ProxyUPath

from schemas.job import absolute

S3_OPTIONS: dict[str, Any] = {
    "use_listings_cache": False,  # other processes write what this one lists
    "max_concurrency": 1,  # more would ask for an object's size before each reading; ours are small
}


class S3ObjectPath(ProxyUPath):
    """An object, or a prefix of objects; picklable, with the methods of `pathlib.Path`.

    Examples
    --------
    >>> path = S3ObjectPath("s3://bucket/run") / "commits" / "lens"
    >>> str(path), path.name
    ('s3://bucket/run/commits/lens', 'lens')
    """

    __slots__ = ()

    def mkdir(self, mode: int = 0o777, parents: bool = False, exist_ok: bool = False) -> None:
        """Do nothing, where UPath asks for the bucket: prefixes exist when objects do."""

    def read_bytes(self) -> bytes:
        """The whole object in one request, where UPath asks for its size first."""
        return bytes(self.fs.cat_file(self.path))

    def write_bytes(self, data: Any) -> int:
        """Write the object in one request: UPath, interrupted in a large object, would leave a part of it."""
        self.fs.pipe_file(self.path, data)
        return len(data)

    def unlink(self, missing_ok: bool = False) -> None:
        """Remove the object in one request; S3 does not report whether there was one."""
        self.fs.rm_file(self.path)

    def version(self) -> str:
        """The ETag of the object's content."""
        return str(self.fs.info(self.path)["ETag"])

    def create(self, data: bytes) -> str | None:
        """Write the object if there is none: its version, or None where there is one."""
        try:
            return str(self.fs.pipe_file(self.path, data, mode="create")["ETag"])
        except FileExistsError:
            return None

    def replace_version(self, version: str, data: bytes) -> str | None:
        """Write the object if its content still is `version`: its new version, or None where it is another or gone."""
        try:
            return str(self.fs.pipe_file(self.path, data, IfMatch=version)["ETag"])
        except FileNotFoundError:
            return None
        except OSError as error:
            if _status(error) in (409, 412):  # another writer is at it, or was
                return None
            raise


def s3_path(path: str) -> S3ObjectPath:
    """The path of ``s3://bucket/key``; ``s3:/bucket/key``, which `pathlib.Path` makes of it, is the same."""
    return S3ObjectPath(absolute(path), **S3_OPTIONS)


def _status(error: OSError) -> int | None:
    """HTTP status of the response that s3fs made an error of."""
    response = getattr(error.__cause__, "response", {})
    status: int | None = response.get("ResponseMetadata", {}).get("HTTPStatusCode")
    return status
