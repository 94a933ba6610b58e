# conform, judge and the pytest plugin for anybody's CI; see docs/ci.md.
FROM python:3.12-slim-bookworm AS wheel
COPY . /source
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheel /source

FROM python:3.12-slim-bookworm
# `ip`, and the virtual machine that has a vcan0 where the kernel of the runner has none (of amd64 only), with the compiler
# that it needs on processors with AMX
RUN apt-get update \
    && apt-get install -y --no-install-recommends iproute2 gcc libc6-dev $(apt-cache search --names-only '^user-mode-linux$' | cut -d' ' -f1) \
    && rm -rf /var/lib/apt/lists/*
COPY --from=wheel /wheel /wheel
RUN pip install --no-cache-dir /wheel/*.whl pytest "python-can[multicast]" && rm -r /wheel
RUN useradd --create-home canprobe
USER canprobe
WORKDIR /home/canprobe
HEALTHCHECK --interval=30s --timeout=10s CMD ["canprobe", "--version"]
CMD ["canprobe", "--help"]
