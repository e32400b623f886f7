/* Solves instances of an exported solver: COUNT of them, shared out among THREADS, each REPEATS times.
 *
 * Standard input holds data, guess and guess of multipliers of each; standard output receives status, answer, multipliers
 * and report. Standard error receives the processor time of one solve in nanoseconds, the least of all.
 */
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "solver.h"

enum { GIVEN = SOLVER_DATA + SOLVER_VALUES + SOLVER_MULTIPLIERS, FOUND = GIVEN - SOLVER_DATA + 1 + SOLVER_REPORT };

static double *given, *found;
static int count, threads, repeats;

static long long now(void) {
  struct timespec t;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
  return 1000000000LL * t.tv_sec + t.tv_nsec;
}

static void *work(void *first) {
  double *space = aligned_alloc(64, (SOLVER_WORKSPACE + 63) / 64 * 64);
  long long least = 1LL << 62;
  memset(space, 0x5a, SOLVER_WORKSPACE); /* nothing but the first word has to be zero */
  space[0] = 0.0;
  for (int k = *(int *)first; k < count; k += threads) {
    const double *in = given + (size_t)k * GIVEN;
    double *out = found + (size_t)k * FOUND;
    for (int r = 0; r < repeats; r++) {
      long long began = now();
      out[0] = solver_solve(in, in + SOLVER_DATA, in + SOLVER_DATA + SOLVER_VALUES, out + 1, out + 1 + SOLVER_VALUES,
                            out + FOUND - SOLVER_REPORT, space);
      long long spent = now() - began;
      if (spent < least) least = spent;
    }
  }
  if (*(int *)first == 0) fprintf(stderr, "%lld\n", least);
  free(space);
  return NULL;
}

int main(int argc, char **argv) {
  pthread_t at[16];
  int first[16];
  count = atoi(argv[1]), threads = atoi(argv[2]), repeats = atoi(argv[3]);
  given = calloc((size_t)count * GIVEN, sizeof(double)), found = calloc((size_t)count * FOUND, sizeof(double));
  if (argc != 4 || fread(given, sizeof(double), (size_t)count * GIVEN, stdin) != (size_t)count * GIVEN) return 1;
  for (int k = 0; k < threads; k++) {
    first[k] = k;
    if (pthread_create(&at[k], NULL, work, &first[k])) return 2;
  }
  for (int k = 0; k < threads; k++) pthread_join(at[k], NULL);
  return fwrite(found, sizeof(double), (size_t)count * FOUND, stdout) != (size_t)count * FOUND;
}
