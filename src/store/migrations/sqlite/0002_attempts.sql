-- What became of each attempt at a job, for whoever wants to know why it failed.
CREATE TABLE attempts (
    job_id     INTEGER NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    attempt    INTEGER NOT NULL,
    -- The process that made it.
    worker     TEXT    NOT NULL,
    start_time INTEGER NOT NULL,
    end_time   INTEGER,
    ending     TEXT CHECK (ending IN ('ENDED', 'GIVEN_BACK', 'LOST')),
    PRIMARY KEY (job_id, attempt)
) STRICT, WITHOUT ROWID;
