# Untested: no machine that builds images has built this yet.
#   docker build -t nir-render .
#   docker run --rm -v "$PWD:/work" nir-render run SCENE.yaml -o OUT
FROM python:3.11-slim-trixie
# Mitsuba renders by LLVM; without it light is slow, and some scenes cannot be rendered.
RUN apt-get update -q && apt-get install -q -y --no-install-recommends libllvm19 && rm -rf /var/lib/apt/lists/*
COPY . /src
RUN pip install --no-cache-dir --constraint /src/constraints.txt /src
WORKDIR /work
ENTRYPOINT ["nir-render"]
