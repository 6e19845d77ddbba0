-- Times are microseconds since the Unix epoch, UTC. Blobs are MessagePack with named fields unless said otherwise.

-- What jobs work on. `input` is the id of an uploaded input; inputs that came inside a job have none.
CREATE TABLE inputs (
    id          INTEGER PRIMARY KEY AUTOINCREMENT,
    tenant      TEXT    NOT NULL,
    input       TEXT,
    -- Of the payload, as it is stored.
    bytes       INTEGER NOT NULL,
    create_time INTEGER NOT NULL,
    -- What an uploaded input says of itself; none of these for one that came inside a job.
    upload_bytes      INTEGER,
    sha256            BLOB,
    view_count        INTEGER,
    track_count       INTEGER,
    observation_count INTEGER,
    -- When it was created, or a job was last created with it.
    use_time          INTEGER,
    UNIQUE (tenant, input)
) STRICT;

CREATE INDEX inputs_use ON inputs (use_time) WHERE input IS NOT NULL;
-- The order of listings; inputs of jobs alone have no name and are in no listing.
CREATE INDEX inputs_listing ON inputs (tenant, create_time, input) WHERE input IS NOT NULL;
-- What a tenant's uploaded inputs count, also those whose name was taken away and that jobs still have.
CREATE INDEX inputs_uploaded ON inputs (tenant, upload_bytes) WHERE upload_bytes IS NOT NULL;

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
        CHECK (state IN ('QUEUED', 'RUNNING', 'SUCCEEDED', 'FAILED', 'CANCELLED', 'DEADLINE_EXCEEDED')),
    -- Attempts begun; of a running job the fencing token of its lease.
    attempt           INTEGER NOT NULL DEFAULT 0,
    -- Attempts whose worker vanished: what the cap on attempts counts.
    lost_attempts     INTEGER NOT NULL DEFAULT 0,
    -- The lease of a running job. A queued one has a lease while a worker has prefetched it: other claims pass over it
    -- until that expires.
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
    -- SHA-256 of the encoded result; none while there is none.
    result_sha256     BLOB,
    -- The id of the uploaded input that the job was created with, also once that has lost its name; none where the
    -- input came inside the job.
    uploaded_input    TEXT,
    -- The Solve calls that have attached to the job so far; NULL: the job does not depend on any caller.
    attached_calls    INTEGER,
    -- Those of them that were disconnected since.
    detached_calls    INTEGER NOT NULL DEFAULT 0,
    UNIQUE (tenant, job),
    CHECK (state <> 'RUNNING' OR lease_expires IS NOT NULL),
    CHECK (state IN ('QUEUED', 'RUNNING') OR lease_expires IS NULL)
) STRICT;

-- Which tenants wait, and the order of claims within one.
CREATE INDEX jobs_queue ON jobs (tenant, priority DESC, create_time, id) WHERE state = 'QUEUED';
-- Covers what admission sums.
CREATE INDEX jobs_load ON jobs (state, input_bytes, observation_count) WHERE state IN ('QUEUED', 'RUNNING');
CREATE INDEX jobs_deadline ON jobs (deadline) WHERE state = 'QUEUED' AND deadline IS NOT NULL;
CREATE INDEX jobs_lease ON jobs (state, lease_expires) WHERE lease_expires IS NOT NULL;
-- The order of listings. Jobs of one microsecond go by their ids, which are their tenant's own: the number of the row
-- would tell in a page token how many jobs all tenants have made.
CREATE INDEX jobs_listing ON jobs (tenant, create_time, job);
CREATE INDEX jobs_input ON jobs (input_id);
-- What retention looks for: jobs that have ended, the oldest end first. Covers what is counted of them.
CREATE INDEX jobs_end ON jobs (end_time, state) WHERE end_time IS NOT NULL;
-- Covers what admission sums of one tenant.
CREATE INDEX jobs_tenant_load ON jobs (tenant, input_bytes, observation_count) WHERE state = 'QUEUED';

-- One row: since when the queue is paused; NULL: it is not.
CREATE TABLE queue (
    id         INTEGER PRIMARY KEY CHECK (id = 1),
    pause_time INTEGER
) STRICT;
INSERT INTO queue (id) VALUES (1);

-- Tenants that ever had a job, and where each stands in the round of claims: the virtual time at which its latest job
-- began. See `store/sql/fairness.rs`.
CREATE TABLE tenants (
    tenant        TEXT    PRIMARY KEY NOT NULL,
    virtual_start INTEGER NOT NULL DEFAULT 0
) STRICT, WITHOUT ROWID;

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

-- Encoded JobResults of the API, as they are read.
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

-- What became of each attempt at a job, for whoever wants to know why it failed.
CREATE TABLE attempts (
    job_id     INTEGER NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    attempt    INTEGER NOT NULL,
    -- The process that made it.
    server     TEXT    NOT NULL,
    start_time INTEGER NOT NULL,
    end_time   INTEGER,
    ending     TEXT CHECK (ending IN ('ENDED', 'GIVEN_BACK', 'LOST')),
    PRIMARY KEY (job_id, attempt)
) STRICT, WITHOUT ROWID;

-- The outbox of webhooks: a job's end that is to be sent, or was.
CREATE TABLE webhooks (
    job_id   INTEGER PRIMARY KEY REFERENCES jobs (id) ON DELETE CASCADE,
    -- Of the URL: attempts at one host are bounded.
    host     TEXT    NOT NULL,
    -- URL, state, attempts and last error.
    webhook  BLOB    NOT NULL,
    -- When the next attempt is due, or the lease of the present one ends. None before the job has ended, and after the
    -- last attempt.
    due_time INTEGER
) STRICT;
CREATE INDEX webhooks_due ON webhooks (due_time) WHERE due_time IS NOT NULL;

-- Uploads: their bytes as they came, until they are an input or are given up.
CREATE TABLE uploads (
    id          INTEGER PRIMARY KEY AUTOINCREMENT,
    tenant      TEXT    NOT NULL,
    -- The caller's id; none once the upload was given up, so that the id is free again.
    upload      TEXT,
    -- Length that the caller declared, and SHA-256, where that was declared too.
    bytes       INTEGER NOT NULL,
    sha256      BLOB,
    -- Bytes that are stored.
    committed   INTEGER NOT NULL DEFAULT 0,
    -- Number of the stream that may write: the latest one.
    writer      INTEGER NOT NULL DEFAULT 0,
    update_time INTEGER NOT NULL,
    -- The input that it became.
    input_id    INTEGER REFERENCES inputs (id) ON DELETE CASCADE,
    -- Its parts are of no use any more, and not all of them are removed.
    leftover    INTEGER NOT NULL DEFAULT 0,
    UNIQUE (tenant, upload)
) STRICT;
CREATE INDEX uploads_open ON uploads (update_time) WHERE input_id IS NULL AND upload IS NOT NULL;
CREATE INDEX uploads_leftover ON uploads (id) WHERE leftover;
CREATE INDEX uploads_input ON uploads (input_id);

CREATE TABLE upload_parts (
    upload_id INTEGER NOT NULL REFERENCES uploads (id) ON DELETE CASCADE,
    at_byte   INTEGER NOT NULL,
    data      BLOB    NOT NULL,
    PRIMARY KEY (upload_id, at_byte)
) STRICT;

-- Jobs for people who query: times as text, labels as JSON.
CREATE VIEW job_list AS SELECT
    tenant, job, state, priority, attempt, lost_attempts, lease_worker, view_count, track_count, observation_count,
    input_bytes,
    strftime('%Y-%m-%dT%H:%M:%fZ', create_time / 1e6, 'unixepoch') AS create_time,
    strftime('%Y-%m-%dT%H:%M:%fZ', start_time / 1e6, 'unixepoch') AS start_time,
    strftime('%Y-%m-%dT%H:%M:%fZ', end_time / 1e6, 'unixepoch') AS end_time,
    strftime('%Y-%m-%dT%H:%M:%fZ', deadline / 1e6, 'unixepoch') AS deadline,
    (SELECT json_group_object(key, value) FROM job_labels WHERE job_id = jobs.id) AS labels
FROM jobs;
