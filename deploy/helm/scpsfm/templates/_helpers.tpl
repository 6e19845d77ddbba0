{{/* The release's name, with the chart's where it does not hold it; short enough for a name in DNS with a suffix. */}}
{{- define "scpsfm.fullname" -}}
{{- $name := ternary .Release.Name (printf "%s-%s" .Release.Name .Chart.Name) (contains .Chart.Name .Release.Name) -}}
{{- $name | trunc 50 | trimSuffix "-" -}}
{{- end }}

{{- define "scpsfm.selectorLabels" -}}
app.kubernetes.io/name: {{ .Chart.Name }}
app.kubernetes.io/instance: {{ .Release.Name }}
{{- end }}

{{- define "scpsfm.labels" -}}
helm.sh/chart: {{ printf "%s-%s" .Chart.Name .Chart.Version }}
{{ include "scpsfm.selectorLabels" . }}
app.kubernetes.io/version: {{ .Values.image.tag | default .Chart.AppVersion | trunc 63 | quote }}
app.kubernetes.io/managed-by: {{ .Release.Service }}
{{- end }}

{{- define "scpsfm.serviceAccountName" -}}
{{- if .Values.serviceAccount.create -}}
{{- .Values.serviceAccount.name | default (include "scpsfm.fullname" .) -}}
{{- else -}}
{{- .Values.serviceAccount.name | default "default" -}}
{{- end -}}
{{- end }}

{{/* What the server would refuse at its start is refused here, in its words. */}}
{{- define "scpsfm.checkAccess" -}}
{{- $open := .Values.tls.unencrypted -}}
{{- if and .Values.tls.secret $open -}}
{{- fail "tls.secret and tls.unencrypted are both set: one or the other" -}}
{{- end -}}
{{- if and (not .Values.tls.secret) (or .Values.tls.clientCaSecret .Values.tls.certManager.enabled) -}}
{{- fail "tls.clientCaSecret and tls.certManager need tls.secret" -}}
{{- end -}}
{{- if and .Values.tls.certManager.enabled (not .Values.tls.certManager.issuerRef.name) -}}
{{- fail "tls.certManager.issuerRef.name: which issuer makes the certificate?" -}}
{{- end -}}
{{- if not .Values.tls.secret -}}
{{- if and .Values.auth.keysSecret (ne $open "keys-in-the-clear") -}}
{{- $right := "tls.secret, or behind a proxy that ends TLS tls.unencrypted=keys-in-the-clear" -}}
{{- fail (printf "without tls.secret the keys would travel readable; right would be %s" $right) -}}
{{- else if and (not .Values.auth.keysSecret) (ne $open "anyone") -}}
{{- $right := "tls.secret and auth.keysSecret, or tls.unencrypted=anyone" -}}
{{- fail (printf "neither TLS nor keys keep strangers out; right would be %s" $right) -}}
{{- end -}}
{{- end -}}
{{- end }}

{{/* One value as TOML writes it. Numbers of values are floats to Helm, and every number of ours is whole. */}}
{{- define "scpsfm.toml" -}}
{{- if kindIs "string" . }}{{ . | toJson }}{{ else if kindIs "bool" . }}{{ . }}{{ else }}{{ int64 . }}{{ end -}}
{{- end }}

{{/* Jobs that wait or run. Replicas share the queue and each tells all of it: the largest count, not the sum. */}}
{{- define "scpsfm.jobsQuery" -}}
{{- $of := printf "namespace=%q,service=%q" .Release.Namespace (printf "%s-metrics" (include "scpsfm.fullname" .)) -}}
max(scpsfm_queue_depth{ {{- $of -}} }) + sum(scpsfm_workers_busy{ {{- $of -}} })
{{- end }}

{{/* Jobs that one replica is there for. */}}
{{- define "scpsfm.jobsPerReplica" -}}
{{- $jobs := int64 (.Values.autoscaling.jobsPerReplica | default .Values.config.engine.workers) -}}
{{- if lt $jobs 1 -}}
{{- fail "autoscaling.jobsPerReplica: needed where config.engine.workers is 0, one a core" -}}
{{- end -}}
{{- $jobs -}}
{{- end }}

{{/* How fast replicas come and go. */}}
{{- define "scpsfm.scalingBehavior" -}}
scaleUp:
  stabilizationWindowSeconds: {{ int64 .Values.autoscaling.scaleUpWindowSeconds }}
scaleDown:
  stabilizationWindowSeconds: {{ int64 .Values.autoscaling.scaleDownWindowSeconds }}
  policies:
    - { type: Pods, value: 1, periodSeconds: 60 }
{{- end }}
