FROM rust:1.95-bookworm AS build
WORKDIR /src
COPY . .
# The caches keep dependencies between builds; the binary is copied out, since a cache is no layer.
RUN --mount=type=cache,target=/usr/local/cargo/registry \
    --mount=type=cache,target=/src/target \
    cargo build --release --locked --bin scpsfm && \
    cp target/release/scpsfm /usr/local/bin/scpsfm

FROM debian:bookworm-slim
# The public authorities, for a database whose certificate one of them has signed (sslmode=verify-full).
RUN apt-get update && apt-get install -y --no-install-recommends ca-certificates && rm -rf /var/lib/apt/lists/*
RUN useradd --system --uid 10001 --home-dir /var/lib/scpsfm --create-home --shell /usr/sbin/nologin scpsfm
COPY --from=build /usr/local/bin/scpsfm /usr/local/bin/scpsfm
USER 10001
WORKDIR /var/lib/scpsfm
VOLUME /var/lib/scpsfm
# Inside a container loopback reaches nobody, so the server listens on every address, and starts only with TLS or when
# told that it needs none:
#   docker run -p 127.0.0.1:50051:50051 -e SCPSFM_SERVER__INSECURE=true IMAGE
#   docker run -p 50051:50051 -v /etc/scpsfm:/etc/scpsfm:ro -e SCPSFM_TLS__CERTIFICATE=/etc/scpsfm/server.pem \
#     -e SCPSFM_TLS__KEY=/etc/scpsfm/server.key -e SCPSFM_AUTH__KEYS_FILE=/etc/scpsfm/keys.txt IMAGE
ENV SCPSFM_SERVER__LISTEN=0.0.0.0:50051 \
    SCPSFM_HTTP__LISTEN=0.0.0.0:8080 \
    SCPSFM_METRICS__LISTEN=0.0.0.0:9464 \
    SCPSFM_STORE__DATA_DIR=/var/lib/scpsfm \
    SCPSFM_LOG__FORMAT=json
EXPOSE 50051 8080 9464
# bash opens the connection itself: the image needs no client for its own check.
HEALTHCHECK --interval=10s --timeout=3s --start-period=20s --retries=3 \
    CMD ["bash", "-c", "exec 3<>/dev/tcp/127.0.0.1/9464 && \
      printf 'GET /readyz HTTP/1.0\\r\\n\\r\\n' >&3 && head -n 1 <&3 | grep -q ' 200 '"]
# The server is process 1 and takes SIGTERM itself: it drains, then exits.
ENTRYPOINT ["scpsfm"]
CMD ["serve"]
