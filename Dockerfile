# hugs without a GPU: models and compiled kernels inside, no network when it runs, not root.
#   docker build -t hugs --build-arg PIP_EXTRA_INDEX_URL=ADDRESS .      ADDRESS: PyTorch's page, "Get started", Pip and CPU
#   docker run --rm --network none -v "$PWD:/clips" hugs run dance.mp4
# Without ADDRESS torch comes with CUDA, several GB more. Files in /clips become those of user 1000. Each RUN line is tried by
# `python -m tests.tools.container`, without Docker.
FROM debian:12-slim
ARG PIP_EXTRA_INDEX_URL
ENV DEBIAN_FRONTEND=noninteractive PATH=/opt/venv/bin:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin HUGS_CACHE=/opt/cache
RUN apt-get update -qq && apt-get install -y -qq --no-install-recommends python3 python3-venv && rm -rf /var/lib/apt/lists/*
RUN useradd --uid 1000 --create-home hugs && mkdir /opt/venv /opt/cache /opt/hugs /clips && chown hugs /opt/venv /opt/cache /opt/hugs /clips
USER hugs
COPY --chown=hugs . /opt/hugs
WORKDIR /opt/hugs
RUN python3 -m venv /opt/venv && pip install --quiet --no-cache-dir --constraint constraints.txt '.[usd,sog]'
WORKDIR /clips
RUN hugs doctor --fetch
RUN hugs demo --pipeline ci --work /tmp/demo && rm -r /tmp/demo
ENTRYPOINT ["hugs"]
