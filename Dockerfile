# One image for every role. By default it runs the whole service; with the command "dispatch" it works on the jobs of
# a store that others share. docs/operations.md shows both.
FROM python:3.11-slim-bookworm

# What Open3D loads and no wheel brings along: the packages of deploy/system_libraries.py.
RUN apt-get update \
    && apt-get install -y --no-install-recommends \
        libegl1 libgl1 libidn2-0 libstdc++6 libudev1 libusb-1.0-0 libx11-6 \
    && rm -rf /var/lib/apt/lists/*

ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1 PYTHONUNBUFFERED=1
WORKDIR /opt/motionlabel

# PyTorch first and alone: asked for by another package it would be the CUDA build, gigabytes of it.
RUN pip install --no-deps --index-url https://download.pytorch.org/whl/cpu torch==2.13.0

# Everything else has wheels for x86_64: no compiler is needed.
COPY pyproject.toml constraints.txt README.md ./
COPY schemas schemas
COPY labeling labeling
COPY workers workers
COPY service service
RUN pip install -c constraints.txt '.[s3,postgres,las,mcap]'

RUN useradd --create-home --uid 1000 motionlabel \
    && mkdir /data /state \
    && chown motionlabel /data /state
USER motionlabel
WORKDIR /data
VOLUME ["/data", "/state"]

# Python looks for no modules in /data, where others write.
ENV PYTHONSAFEPATH=1
ENV MOTIONLABEL_HOST=0.0.0.0 MOTIONLABEL_PORT=8000 MOTIONLABEL_DATA_DIR=/state MOTIONLABEL_DATA_ROOTS=/data
# Whoever calls from outside of the container needs a key; the command "key new" makes one.
ENV MOTIONLABEL_API_KEYS_FILE=/state/api-keys
EXPOSE 8000
HEALTHCHECK --interval=30s --timeout=5s --start-period=60s \
    CMD ["python", "-I", "-c", "import urllib.request as r; r.urlopen('http://127.0.0.1:8000/healthz', timeout=4)"]
ENTRYPOINT ["motionlabel"]
CMD ["serve"]
