-- What a tenant's uploaded inputs count, in bytes as they were uploaded: also those whose name was taken away and that jobs
-- still have.
DROP INDEX inputs_uploaded;
CREATE INDEX inputs_uploaded ON inputs (tenant, upload_bytes) WHERE upload_bytes IS NOT NULL;
