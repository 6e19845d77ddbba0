-- Times are microseconds since the Unix epoch, UTC. Blobs are MessagePack with named fields unless said otherwise.

-- What jobs work on. `input` is the id of an uploaded input; inputs that came inside a job have none.
CREATE TABLE inputs (
    id          INTEGER PRIMARY KEY AUTOINCREMENT,
    tenant      TEXT    NOT NULL,
    input       TEXT,
    bytes       INTEGER NOT NULL,
    create_time INTEGER NOT NULL,
    UNIQUE (tenant, input)
) STRICT;

-- Payloads lie in rows of bounded size, so that no statement needs the whole in one buffer of the database.
CREATE TABLE input_chunks (
    input_id INTEGER NOT NULL REFERENCES inputs (id) ON DELETE CASCADE,
    chunk    INTEGER NOT NULL,
    data     BLOB    NOT NULL,
    PRIMARY KEY (input_id, chunk)
) STRICT;

CREATE TABLE jobs (
    id                INTEGER PRIMARY KEY AUTOINCREMENT,
    tenant            TEXT    NOT NULL,
    job               TEXT    NOT NULL,
    state             TEXT    NOT NULL
        CHECK (state IN ('QUEUED', 'RUNNING', 'SUCCEEDED', 'FAILED', 'CANCELLED', 'EXPIRED')),
    -- Attempts begun; of a running job the fencing token of its lease.
    attempt           INTEGER NOT NULL DEFAULT 0,
    -- Attempts whose worker vanished: what the cap on attempts counts.
    lost_attempts     INTEGER NOT NULL DEFAULT 0,
    lease_worker      TEXT,
    lease_expires     INTEGER,
    cancel_requested  INTEGER NOT NULL DEFAULT 0,
    priority          INTEGER NOT NULL,
    create_time       INTEGER NOT NULL,
    -- When the job last entered the queue.
    queue_time        INTEGER NOT NULL,
    start_time        INTEGER,
    end_time          INTEGER,
    deadline          INTEGER,
    input_id          INTEGER NOT NULL REFERENCES inputs (id),
    input_bytes       INTEGER NOT NULL,
    view_count        INTEGER NOT NULL,
    track_count       INTEGER NOT NULL,
    observation_count INTEGER NOT NULL,
    settings          BLOB    NOT NULL,
    labels            BLOB    NOT NULL,
    trace_parent      TEXT,
    progress          BLOB,
    summary           BLOB,
    failure           BLOB,
    last_sequence     INTEGER NOT NULL DEFAULT 0,
    UNIQUE (tenant, job),
    CHECK ((state = 'RUNNING') = (lease_expires IS NOT NULL))
) STRICT;

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
    job_id INTEGER NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    key    TEXT    NOT NULL,
    value  TEXT    NOT NULL,
    PRIMARY KEY (job_id, key)
) STRICT, WITHOUT ROWID;

CREATE TABLE events (
    job_id   INTEGER NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    sequence INTEGER NOT NULL,
    attempt  INTEGER NOT NULL,
    time     INTEGER NOT NULL,
    body     BLOB    NOT NULL,
    PRIMARY KEY (job_id, sequence)
) STRICT, WITHOUT ROWID;

CREATE TABLE result_chunks (
    job_id INTEGER NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    chunk  INTEGER NOT NULL,
    data   BLOB    NOT NULL,
    PRIMARY KEY (job_id, chunk)
) STRICT;

-- Idempotent creation: one request id of one tenant stands for one body (SHA-256) and one job.
CREATE TABLE request_ids (
    tenant      TEXT    NOT NULL,
    request_id  TEXT    NOT NULL,
    digest      BLOB    NOT NULL,
    job_id      INTEGER NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    create_time INTEGER NOT NULL,
    PRIMARY KEY (tenant, request_id)
) STRICT, WITHOUT ROWID;
CREATE INDEX request_ids_job ON request_ids (job_id);
