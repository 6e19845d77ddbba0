"""Receives webhooks of scpsfm and prints the jobs that ended.

    WEBHOOK_SECRET=whsec_... python docs/examples/webhook_receiver.py 127.0.0.1:9000

The secret is the server's webhooks.secret, or that of the tenant. Needs nothing but Python. Prints where it listens,
then name and state of each job; a delivery that comes twice is printed once.
"""

import base64
import hashlib
import hmac
import json
import os
import sys
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

SECRET = base64.b64decode(os.environ["WEBHOOK_SECRET"].removeprefix("whsec_"))
MAX_AGE_SECONDS = 300
MAX_BODY_BYTES = 1 << 20


def is_genuine(headers, body):
    """Whether a delivery is signed with the secret, and is no old one that somebody sends again."""
    message_id, timestamp = headers.get("webhook-id", ""), headers.get("webhook-timestamp", "")
    if not timestamp.isdecimal() or abs(time.time() - int(timestamp)) > MAX_AGE_SECONDS:
        return False
    signed = f"{message_id}.{timestamp}.".encode() + body
    expected = "v1," + base64.b64encode(hmac.new(SECRET, signed, hashlib.sha256).digest()).decode()
    given = headers.get("webhook-signature", "").split()
    return any(hmac.compare_digest(expected.encode(), signature.encode()) for signature in given)


class Receiver(BaseHTTPRequestHandler):
    """Answers deliveries."""

    seen = set()

    def do_POST(self):
        """Takes a delivery."""
        length = int(self.headers.get("content-length", 0))
        body = self.rfile.read(length) if length <= MAX_BODY_BYTES else b""
        if not is_genuine(self.headers, body):
            self.send_error(401)
            return
        if self.headers["webhook-id"] not in self.seen:
            self.seen.add(self.headers["webhook-id"])
            job = json.loads(body)
            print(job["name"], job["state"], flush=True)
        self.send_response(204)
        self.end_headers()

    def log_message(self, *_):
        """Says nothing of its own."""


if __name__ == "__main__":
    host, _, port = sys.argv[1].rpartition(":")
    server = ThreadingHTTPServer((host, int(port)), Receiver)
    print(f"listening on http://{host}:{server.server_port}", flush=True)
    server.serve_forever()
