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

-- What an uploaded input says of itself; none of these for one that came inside a job.
ALTER TABLE inputs ADD COLUMN upload_bytes INTEGER;
ALTER TABLE inputs ADD COLUMN sha256 BLOB;
ALTER TABLE inputs ADD COLUMN view_count INTEGER;
ALTER TABLE inputs ADD COLUMN track_count INTEGER;
ALTER TABLE inputs ADD COLUMN observation_count INTEGER;
-- When it was created, or a job was last created with it.
ALTER TABLE inputs ADD COLUMN use_time INTEGER;
CREATE INDEX inputs_use ON inputs (use_time) WHERE input IS NOT NULL;
