# handsim with torch's CPU build. This file is linted and not built by the tests.
#   docker build -t handsim . && docker run --rm -v "$PWD:/work" handsim track take.c3d --glove dense19 --out take.npz
FROM python:3.12-slim-bookworm

# Debian keeps no old versions of its packages, so that pinned ones would soon be gone.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends git libegl1 libegl-mesa0 libgl1-mesa-dri libgl1 libopengl0 \
    && rm -rf /var/lib/apt/lists/*

COPY . /opt/handsim
RUN pip install --no-cache-dir --constraint /opt/handsim/constraints.txt \
        --extra-index-url https://download.pytorch.org/whl/cpu "/opt/handsim[onnx,view,send]" \
    && handsim doctor --compile

WORKDIR /work
ENTRYPOINT ["handsim"]
CMD ["--help"]
