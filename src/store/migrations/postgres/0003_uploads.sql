-- Uploads: their bytes as they came, until they are an input or are given up.
CREATE TABLE uploads (
    id          BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    tenant      TEXT    NOT NULL,
    -- The caller's id; none once the upload was given up, so that the id is free again.
    upload      TEXT,
    -- Length that the caller declared, and SHA-256, where that was declared too.
    bytes       BIGINT NOT NULL,
    sha256      BYTEA,
    -- Bytes that are stored.
    committed   BIGINT NOT NULL DEFAULT 0,
    -- Number of the stream that may write: the latest one.
    writer      BIGINT NOT NULL DEFAULT 0,
    update_time BIGINT NOT NULL,
    -- The input that it became.
    input_id    BIGINT REFERENCES inputs (id) ON DELETE CASCADE,
    -- Its parts are of no use any more, and not all of them are removed.
    leftover    BOOLEAN NOT NULL DEFAULT FALSE,
    UNIQUE (tenant, upload)
);
CREATE INDEX uploads_open ON uploads (update_time) WHERE input_id IS NULL AND upload IS NOT NULL;
CREATE INDEX uploads_leftover ON uploads (id) WHERE leftover;
CREATE INDEX uploads_input ON uploads (input_id);

CREATE TABLE upload_parts (
    upload_id BIGINT NOT NULL REFERENCES uploads (id) ON DELETE CASCADE,
    at_byte   BIGINT NOT NULL,
    data      BYTEA    NOT NULL,
    PRIMARY KEY (upload_id, at_byte)
);

-- What an uploaded input says of itself; none of these for one that came inside a job.
ALTER TABLE inputs ADD COLUMN upload_bytes BIGINT;
ALTER TABLE inputs ADD COLUMN sha256 BYTEA;
ALTER TABLE inputs ADD COLUMN view_count BIGINT;
ALTER TABLE inputs ADD COLUMN track_count BIGINT;
ALTER TABLE inputs ADD COLUMN observation_count BIGINT;
-- When it was created, or a job was last created with it.
ALTER TABLE inputs ADD COLUMN use_time BIGINT;
CREATE INDEX inputs_use ON inputs (use_time) WHERE input IS NOT NULL;
