-- The Solve calls that have attached to a job so far; NULL: the job does not depend on any caller.
ALTER TABLE jobs ADD COLUMN attached_calls BIGINT;
-- Those of them that were disconnected since.
ALTER TABLE jobs ADD COLUMN detached_calls BIGINT NOT NULL DEFAULT 0;
