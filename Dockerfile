# hineus on the CPU, for any user and without a home:
#
#   docker build -t hineus .
#   docker run --rm -u "$(id -u):$(id -g)" -v "$PWD:/data" hineus run photos
#
# Results are written into the mounted folder and belong to you. `docs/install.md` has more; `make image` builds it and
# tries it out, with docker, podman or buildah.

ARG BASE=debian:bookworm-slim

FROM ${BASE} AS build
RUN apt-get update && apt-get install -y --no-install-recommends python3 python3-venv ca-certificates
RUN python3 -m venv /opt/hineus
# The CPU build by itself first: the usual index has the one for CUDA, several gigabytes.
ARG TORCH=torch==2.13.0
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
RUN /opt/hineus/bin/pip install --no-cache-dir --index-url "${TORCH_INDEX}" "${TORCH}"
COPY . /source
ARG EXTRAS=raw,collision,masks,features,geo,survey
RUN /opt/hineus/bin/pip install --no-cache-dir "/source[${EXTRAS}]"

FROM ${BASE}
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 libgl1 libegl1 libopengl0 libx11-6 libusb-1.0-0 libidn2-0 \
       libatomic1 libgomp1 \
    && rm -rf /var/lib/apt/lists/*
COPY --from=build /opt/hineus /opt/hineus
ENV PATH=/opt/hineus/bin:$PATH PYTHONDONTWRITEBYTECODE=1 NUMBA_CACHE_DIR=/var/cache/hineus
# Any user may add to the compiled code: a container has one. The demo compiles it, and shows that the image works.
RUN hineus doctor \
    && hineus demo --preset tiny --workspace /tmp/demo \
    && rm -r /tmp/demo /root/.cache \
    && chmod -R a+rwX /var/cache/hineus
WORKDIR /data
ENTRYPOINT ["hineus"]
CMD ["--help"]
