-- Times are microseconds since the Unix epoch, UTC. Bytes are MessagePack with named fields unless said otherwise.

-- What jobs work on. `input` is the id of an uploaded input; inputs that came inside a job have none.
CREATE TABLE inputs (
    id          BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    tenant      TEXT    NOT NULL,
    input       TEXT,
    bytes       BIGINT NOT NULL,
    create_time BIGINT NOT NULL,
    UNIQUE (tenant, input)
);

-- Payloads lie in rows of bounded size, so that no statement needs the whole in one buffer of the database.
CREATE TABLE input_chunks (
    input_id BIGINT NOT NULL REFERENCES inputs (id) ON DELETE CASCADE,
    chunk    BIGINT NOT NULL,
    data     BYTEA   NOT NULL,
    PRIMARY KEY (input_id, chunk)
);

CREATE TABLE jobs (
    id                BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    tenant            TEXT    NOT NULL,
    job               TEXT    NOT NULL,
    state             TEXT    NOT NULL
        CHECK (state IN ('QUEUED', 'RUNNING', 'SUCCEEDED', 'FAILED', 'CANCELLED', 'EXPIRED')),
    -- Attempts begun; of a running job the fencing token of its lease.
    attempt           BIGINT NOT NULL DEFAULT 0,
    -- Attempts whose worker vanished: what the cap on attempts counts.
    lost_attempts     BIGINT NOT NULL DEFAULT 0,
    lease_worker      TEXT,
    lease_expires     BIGINT,
    cancel_requested  BOOLEAN NOT NULL DEFAULT FALSE,
    priority          BIGINT NOT NULL,
    create_time       BIGINT NOT NULL,
    -- When the job last entered the queue.
    queue_time        BIGINT NOT NULL,
    start_time        BIGINT,
    end_time          BIGINT,
    deadline          BIGINT,
    input_id          BIGINT NOT NULL REFERENCES inputs (id),
    input_bytes       BIGINT NOT NULL,
    view_count        BIGINT NOT NULL,
    track_count       BIGINT NOT NULL,
    observation_count BIGINT NOT NULL,
    settings          BYTEA   NOT NULL,
    labels            BYTEA   NOT NULL,
    trace_parent      TEXT,
    progress          BYTEA,
    summary           BYTEA,
    failure           BYTEA,
    last_sequence     BIGINT NOT NULL DEFAULT 0,
    UNIQUE (tenant, job),
    CHECK ((state = 'RUNNING') = (lease_expires IS NOT NULL))
);

-- The order of claims.
CREATE INDEX jobs_queue ON jobs (priority DESC, create_time, id) WHERE state = 'QUEUED';
-- Covers what admission sums.
CREATE INDEX jobs_load ON jobs (state, input_bytes, observation_count) WHERE state IN ('QUEUED', 'RUNNING');
CREATE INDEX jobs_deadline ON jobs (deadline) WHERE state = 'QUEUED' AND deadline IS NOT NULL;
CREATE INDEX jobs_lease ON jobs (lease_expires) WHERE state = 'RUNNING';
CREATE INDEX jobs_listing ON jobs (tenant, create_time, id);
CREATE INDEX jobs_input ON jobs (input_id);

-- The labels once more, for filters.
CREATE TABLE job_labels (
    job_id BIGINT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    key    TEXT    NOT NULL,
    value  TEXT    NOT NULL,
    PRIMARY KEY (job_id, key)
);

CREATE TABLE events (
    job_id   BIGINT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    sequence BIGINT NOT NULL,
    attempt  BIGINT NOT NULL,
    time     BIGINT NOT NULL,
    body     BYTEA   NOT NULL,
    PRIMARY KEY (job_id, sequence)
);

CREATE TABLE result_chunks (
    job_id BIGINT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    chunk  BIGINT NOT NULL,
    data   BYTEA   NOT NULL,
    PRIMARY KEY (job_id, chunk)
);

-- Idempotent creation: one request id of one tenant stands for one body (SHA-256) and one job.
CREATE TABLE request_ids (
    tenant      TEXT    NOT NULL,
    request_id  TEXT    NOT NULL,
    digest      BYTEA   NOT NULL,
    job_id      BIGINT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    create_time BIGINT NOT NULL,
    PRIMARY KEY (tenant, request_id)
);
CREATE INDEX request_ids_job ON request_ids (job_id);

-- What became of each attempt at a job, for whoever wants to know why it failed.
CREATE TABLE attempts (
    job_id     BIGINT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    attempt    BIGINT NOT NULL,
    -- The process that made it.
    worker     TEXT    NOT NULL,
    start_time BIGINT NOT NULL,
    end_time   BIGINT,
    ending     TEXT CHECK (ending IN ('ENDED', 'GIVEN_BACK', 'LOST')),
    PRIMARY KEY (job_id, attempt)
);
