FROM python:3.13-slim

# A home of its own: compiled kernels and models are kept there. /recordings and /state are made here so that new
# volumes belong to the user.
RUN useradd --create-home --uid 1000 reactorwatch \
    && install --directory --owner=reactorwatch /recordings /state

WORKDIR /app
COPY pyproject.toml README.md LICENSE ./
COPY reactorwatch ./reactorwatch
COPY plant_node ./plant_node
COPY monitor_node ./monitor_node
COPY recorder ./recorder
COPY diagnosis ./diagnosis
RUN pip install --no-cache-dir '.[metrics]'

USER reactorwatch
WORKDIR /home/reactorwatch
# Else each new container compiles for half a minute in the middle of a watch.
RUN reactorwatch compile
STOPSIGNAL SIGTERM
ENTRYPOINT ["reactorwatch"]
