# velfield for every service of compose.yaml: the command, Prefect's server, Dask's scheduler and workers.
#   docker build -t velfield .
# The page is built first, by Node, so that the image itself holds none.
FROM node:22-slim AS page
RUN apt-get update && apt-get install -y --no-install-recommends python3 && rm -rf /var/lib/apt/lists/*
WORKDIR /source
COPY page page
COPY velfield velfield
RUN python3 page/build.py

FROM python:3.12-slim AS wheel
WORKDIR /source
COPY --from=page /source/velfield velfield
COPY page page
COPY flows flows
COPY schemas schemas
COPY pyproject.toml README.md LICENSE THIRD-PARTY-LICENSES.md ./
RUN pip install --no-cache-dir build && python -m build --wheel

FROM python:3.12-slim
ENV PYTHONUNBUFFERED=1 \
    PREFECT_SERVER_ANALYTICS_ENABLED=false \
    DO_NOT_TRACK=1 \
    OMP_NUM_THREADS=1 \
    OPENBLAS_NUM_THREADS=1 \
    MALLOC_TRIM_THRESHOLD_=268435456 \
    MALLOC_MMAP_THRESHOLD_=33554432
COPY requirements.lock /tmp/requirements.lock
COPY --from=wheel /source/dist /tmp/dist
# The versions of the lock, of what the wheel and its extras need.
RUN sed 's/ *--hash=[^ ]*//; s/ *\\$//; /^ *$/d' /tmp/requirements.lock > /tmp/constraints.txt \
    && pip install --no-cache-dir --constraint /tmp/constraints.txt "$(ls /tmp/dist/*.whl)[s3]" asyncpg \
    && rm -rf /tmp/dist /tmp/requirements.lock /tmp/constraints.txt \
    && useradd --create-home --uid 1000 velfield
USER velfield
WORKDIR /data
ENTRYPOINT ["velfield"]
CMD ["--help"]
