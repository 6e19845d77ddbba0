-- What a tenant's uploaded inputs take, also those whose name was taken away and that jobs still have.
CREATE INDEX inputs_uploaded ON inputs (tenant, bytes) WHERE upload_bytes IS NOT NULL;
