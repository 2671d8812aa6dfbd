/* A dense Kalman filter in Joseph form, 15 states and 3 measurements, as one would write it by hand:
 * the reference of the throughput benchmark for what a core can do without knowing any structure.
 *
 * A group is one covariance recursion; its series are the runs that share it. */

#include <math.h>
#include <string.h>

#define N 15
#define M 3

/* C = A B for constant sizes. A row is gathered in registers before it is stored. */
#define MULTIPLY(name, rows, inner, columns)                                                 \
  static void name(const double *restrict A, const double *restrict B, double *restrict C) { \
    for (int i = 0; i < rows; i++) {                                                         \
      double row[columns] = {0.0};                                                           \
      for (int k = 0; k < inner; k++)                                                        \
        for (int j = 0; j < columns; j++) row[j] += A[i * inner + k] * B[k * columns + j];   \
      for (int j = 0; j < columns; j++) C[i * columns + j] = row[j];                         \
    }                                                                                        \
  }

MULTIPLY(times_nnn, N, N, N)
MULTIPLY(times_mnn, M, N, N)
MULTIPLY(times_mnm, M, N, M)
MULTIPLY(times_nmn, N, M, N)
MULTIPLY(times_nmm, N, M, M)

static void transpose(const double *restrict A, double *restrict At, int rows, int columns) {
  for (int i = 0; i < rows; i++)
    for (int j = 0; j < columns; j++) At[j * rows + i] = A[i * columns + j];
}

/* Inverse of a 3x3 matrix by cofactors; returns the determinant. */
static double inverse3(const double *S, double *I) {
  double a = S[4] * S[8] - S[5] * S[7], b = S[5] * S[6] - S[3] * S[8], c = S[3] * S[7] - S[4] * S[6];
  double det = S[0] * a + S[1] * b + S[2] * c, r = 1.0 / det;
  I[0] = a * r, I[1] = (S[2] * S[7] - S[1] * S[8]) * r, I[2] = (S[1] * S[5] - S[2] * S[4]) * r;
  I[3] = b * r, I[4] = (S[0] * S[8] - S[2] * S[6]) * r, I[5] = (S[2] * S[3] - S[0] * S[5]) * r;
  I[6] = c * r, I[7] = (S[1] * S[6] - S[0] * S[7]) * r, I[8] = (S[0] * S[4] - S[1] * S[3]) * r;
  return det;
}

/* One step of the covariance: P is moved to the next epoch; K, the inverse and determinant of S. */
static double step_covariance(const double *F, const double *Q, double scale, const double *H,
                              const double *R, double *P, double *K, double *Si) {
  double Ft[N * N], Ht[N * M], T[N * N], U[N * N], HP[M * N], S[M * M], PHt[N * M], Kt[M * N], KR[N * M];
  transpose(F, Ft, N, N);
  transpose(H, Ht, M, N);
  times_nnn(F, P, T);
  times_nnn(T, Ft, P);
  for (int i = 0; i < N * N; i++) P[i] += scale * Q[i];
  times_mnn(H, P, HP);
  times_mnm(HP, Ht, S);
  for (int i = 0; i < M * M; i++) S[i] += R[i];
  double det = inverse3(S, Si);
  transpose(HP, PHt, M, N);
  times_nmm(PHt, Si, K);
  times_nmn(K, H, U);
  for (int i = 0; i < N * N; i++) U[i] = -U[i];
  for (int i = 0; i < N; i++) U[i * N + i] += 1.0;
  times_nnn(U, P, T);
  transpose(U, Ft, N, N);
  times_nnn(T, Ft, P);
  times_nmm(K, R, KR);
  transpose(K, Kt, N, M);
  times_nmn(KR, Kt, U);
  for (int i = 0; i < N * N; i++) P[i] += U[i];
  return det;
}

static double step_mean(const double *F, const double *H, const double *K, const double *Si,
                        const double *z, double *x) {
  double y[N], nu[M], nis = 0.0;
  for (int i = 0; i < N; i++) {
    y[i] = 0.0;
    for (int j = 0; j < N; j++) y[i] += F[i * N + j] * x[j];
  }
  for (int i = 0; i < M; i++) {
    nu[i] = z[i];
    for (int j = 0; j < N; j++) nu[i] -= H[i * N + j] * y[j];
  }
  for (int i = 0; i < N; i++) {
    x[i] = y[i];
    for (int j = 0; j < M; j++) x[i] += K[i * M + j] * nu[j];
  }
  for (int i = 0; i < M; i++)
    for (int j = 0; j < M; j++) nis += nu[i] * Si[i * M + j] * nu[j];
  return nis;
}

/* F, Q: (distinct, steps, N, N), one per `models` groups if own, else one for all. z: (runs, steps, M).
 * own: groups = runs * models of one series; else groups = models of `runs` series.
 * x: (groups * series, N) work space; attitude: (groups, series, steps, M); log_likelihood:
 * (groups, series), summed over the steps. */
void kalman_bank(long own, long runs, long models, long steps, const double *F, const double *Q,
                 const double *theta, const double *H, const double *R, const double *P0,
                 const double *z, double *x, double *attitude, double *log_likelihood) {
  long groups = own ? runs * models : models, series = own ? 1 : runs;
  memset(x, 0, sizeof(double) * groups * series * N);
  memset(log_likelihood, 0, sizeof(double) * groups * series);
  for (long g = 0; g < groups; g++) {
    long run = own ? g / models : 0;
    double P[N * N], K[N * M], Si[M * M];
    memcpy(P, P0, sizeof P);
    for (long k = 0; k < steps; k++) {
      const double *Fk = F + (run * steps + k) * N * N, *Qk = Q + (run * steps + k) * N * N;
      double det = step_covariance(Fk, Qk, theta[g % models], H, R, P, K, Si);
      double constant = log(det) + M * log(2.0 * M_PI);
      for (long s = 0; s < series; s++) {
        long row = g * series + s;
        double *xs = x + row * N;
        double nis = step_mean(Fk, H, K, Si, z + ((run + s) * steps + k) * M, xs);
        memcpy(attitude + (row * steps + k) * M, xs, sizeof(double) * M);
        log_likelihood[row] -= 0.5 * (nis + constant);
      }
    }
  }
}
