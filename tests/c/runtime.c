/* The runtime alone, under a made-up arm whose kernels do what a test asks them: NaN, singular matrices, overflow. It goes
 * through what no robot does every day, and counts branches (R1 to R36 of docs/reference/runtime.md).
 *
 * Three joints with unit inertia; the third one turns without end. phi = (atan(q0), q1, q2), undefined where |q0| > 50;
 * the law is a spring and a damper. Exits with the number of failed checks, and prints their lines. */
#include <stdio.h>

#define ORTHOCAS_API static
#include "orthocas_runtime.c"

#define N 3
#define M 2
#define K 3
#define ROOMS 1
#define WORK ORTHOCAS_LAW_WORK(N, K, 1, 2 * N)

static int failures = 0;
#define CHECK(condition) ((condition) ? (void)0 : (void)(++failures, printf("line %d: %s\n", __LINE__, #condition)))

/* ---- what kernels do ---- */

static struct {
  double phi, jacobian, curvature, mass, bias, gravity, deviation, gap, A, B, fallback, law, gram, near, inwards, memory;
  double turned;  /* added to what they return */
  double coupling, step; /* of gram; of the implied motion */
  int singular, heavy, rank; /* A and M are singular; the mass matrix is large; equations of a step have no solution */
  int status;
} fault;

static void good(void) {
  memset(&fault, 0, sizeof fault);
  fault.step = 1.0;
}

static void chart_at(const double *q, double *phi, double *jacobian) {
  int i;
  for (i = 0; i < N * N; ++i) jacobian[i] = i % (N + 1) == 0 ? 1.0 : 0.0;
  for (i = 0; i < N; ++i) phi[i] = q[i];
  phi[0] = fabs(q[0]) <= 50.0 ? atan(q[0]) + fault.phi : NAN;
  jacobian[0] = fault.singular ? 0.0 : 1.0 / (1.0 + q[0] * q[0]);
  jacobian[1] = fault.jacobian;
}

static void curvature_at(const double *q, const double *dq, const double *v, double *curvature) {
  int i;
  for (i = 0; i < N; ++i) curvature[i] = q[i] * dq[i] * v[i] + fault.curvature;
}

static void dynamics_at(const double *q, const double *dq, double *mass_matrix, double *bias, double *gravity) {
  int i;
  for (i = 0; i < N * N; ++i) mass_matrix[i] = i % (N + 1) == 0 ? (fault.singular ? 0.0 : 1.0) : 0.0;
  mass_matrix[0] += fault.mass + (fault.heavy ? 1e99 : 0.0);
  for (i = 0; i < N; ++i) gravity[i] = 0.1 * q[i] + fault.gravity;
  for (i = 0; i < N; ++i) bias[i] = gravity[i] + 0.01 * dq[i] + fault.bias;
}

static void near_at(const double *q, const double *wanted, double *e, double *slopes, double *rooms, double *inwards) {
  int i;
  for (i = 0; i < N * N; ++i) slopes[i] = i % (N + 1) == 0 ? 1.0 : 0.0;
  for (i = 0; i < N; ++i) e[i] = q[i] - wanted[i];
  slopes[0] = fault.rank ? 1e-200 : 1.0 + fault.near;
  rooms[0] = 4.0 - q[0] * q[0] - q[1] * q[1] - 0.5 * sin(5.0 * q[0]) * sin(5.0 * q[0]) + (fault.inwards < 0.0 ? -100.0 : 0.0);
  for (i = 0; i < N; ++i) inwards[i] = i < 2 ? -2.0 * q[i] : 0.0;
  inwards[0] += fault.inwards;
}

static int is_clear(const double *q) { return q[0] * q[0] + q[1] * q[1] < 4.0; }

static void turned_at(const double *q, const double *phi, const double *wanted, double *left, double *rates) {
  int i;
  (void)q;
  for (i = 0; i < M; ++i) left[i] = wanted[i] - phi[i] + fault.turned;
  (void)rates;
}

static void shared_at(const double *q, const double *dq, double *shared) { shared[0] = q[0] + dq[0]; }

static int control_at(const double *shared, const double *q, const double *dq, const orthocas_reference *reference,
                      const void *gains, double *command) {
  int i;
  (void)shared;
  (void)gains;
  for (i = 0; i < N; ++i) command[i] = 20.0 * (reference->value[i] - q[i]) - 4.0 * dq[i] + 0.1 * q[i] + fault.law;
  return fault.status;
}

static void deviation_at(const double *shared, const double *q, const double *value, double *measured, double *error) {
  int i;
  (void)shared;
  for (i = 0; i < K; ++i) measured[i] = q[i] + fault.deviation;
  for (i = 0; i < K; ++i) error[i] = value[i] - q[i] + fault.deviation;
}

static void implied_at(const double *shared, const double *q, const double *dq, const orthocas_reference *reference,
                       const double *change, double *A, double *B) {
  int i;
  (void)shared;
  (void)q;
  (void)dq;
  for (i = 0; i < N * N; ++i) A[i] = i % (N + 1) == 0 ? (fault.singular ? 0.0 : 1.0) : 0.0;
  A[1] = fault.A;
  for (i = 0; i < N; ++i) {
    B[i] = fault.step * change[i] + fault.B;
    B[N + i] = reference->velocity[i];
    B[2 * N + i] = reference->acceleration[i];
  }
}

static void fallback_of(const double *q, const void *gains, double *command) {
  int i;
  (void)gains;
  for (i = 0; i < N; ++i) command[i] = 0.1 * q[i] + fault.fallback;
}

static void gap_between(const orthocas_reference *from, const double *to, double *way, double *rate, double *change) {
  int i;
  for (i = 0; i < K; ++i) {
    way[i] = to[i] - from->value[i] + fault.gap;
    rate[i] = from->velocity[i];
    change[i] = from->acceleration[i];
  }
}

static void moved_from(const double *from, const double *step, const orthocas_reference *reference, double *value,
                       double *velocity, double *acceleration) {
  int i;
  for (i = 0; i < M; ++i) {
    value[i] = from[i] + step[i];
    velocity[i] = reference->velocity[i];
    acceleration[i] = reference->acceleration[i];
  }
}

static void turned_by(const double *from, const double *way, const double *velocity, const double *acceleration,
                      const orthocas_reference *to) {
  int i;
  for (i = 0; i < M; ++i) {
    to->value[i] = from[i] + way[i] + fault.turned;
    to->velocity[i] = velocity[i];
    to->acceleration[i] = acceleration[i];
  }
}

static void remembered(const double *q, const double *dq, const orthocas_reference *reference, const void *gains,
                       const double *command, double active, double period, const double *last, double *memory) {
  int i;
  (void)q;
  (void)dq;
  (void)reference;
  (void)gains;
  for (i = 0; i < 2 * N; ++i) memory[i] = last[i] + active * period * command[i % N] + fault.memory;
}

static void add_memory(const double *memory, void *gains) { ((double *)gains)[N] = memory[0]; }

static void gram_at(const double *q, double *gram) {
  gram[0] = gram[3] = 1.0 + fault.gram;
  gram[0] += q[0] * q[0];
  gram[1] = gram[2] = fault.coupling;
}

static double room_to_fold(const double *q) { return 1.0 - 0.25 * q[1] * q[1]; }

/* ---- arms ---- */

static const double low[N] = {-1.5, -1.5, -INFINITY}, high[N] = {1.5, 1.5, INFINITY};
static const double centre[N] = {0}, half[N] = {1.5, 1.5, 1.0}, reach[N] = {1.5, 1.5, INFINITY}, ones[N] = {1, 1, 1};
static const double phi_turn[N] = {0, 0, 6.283185307179586}, phi_rounds[N] = {0, 0, 1.0 / 6.283185307179586};
static const double turns[N] = {0, 0, 6.283185307179586}, nothing[2 * N] = {0}, limits[N] = {50, 50, 50};
static const double gains_of[2 * N] = {50, 50, 50, 0, 0, 0}; /* limit, then a torque */
static const int bounded[N] = {1, 1, 0}, turning[N] = {0, 0, 1}, joints[2] = {0, 1};
static const double radius[2] = {0.8, 0.8}, line_start[4] = {0, 0, 0.5, 0}, line_axis[4] = {1, 0, 0, 1};
static const double line_length[2] = {0.5, 0.5};

static orthocas_arm plain(void) {
  orthocas_arm arm = {0};
  arm.n = N;
  arm.m = M;
  arm.k = K;
  arm.rooms = ROOMS;
  arm.lower = low;
  arm.upper = high;
  arm.centre = centre;
  arm.half_width = half;
  arm.reach = reach;
  arm.phi_size = ones;
  arm.numbers = (orthocas_numbers){1e100, 1e-300, 1e6, 1e-12, 1e-10, 1e-14, 1e-5, 1e-12};
  arm.reaching = (orthocas_reaching){0.3, 1e-11, 4.0, 3.0, 1e-4, 1e-8, 1e-6, 1e-12, 3, 40};
  arm.kernels.chart = chart_at;
  arm.kernels.curvature = curvature_at;
  arm.kernels.dynamics = dynamics_at;
  arm.kernels.near = near_at;
  arm.kernels.shared = shared_at;
  arm.kernels.control = control_at;
  arm.kernels.deviation = deviation_at;
  arm.kernels.implied = implied_at;
  arm.kernels.fallback = fallback_of;
  arm.kernels.gap = gap_between;
  arm.torque = 1;
  arm.integral_bound = 5.0;
  arm.shared = 1;
  arm.memory_torque = -1;
  arm.bounded = bounded;
  arm.turning = turning;
  arm.unit = half;
  arm.default_gains = gains_of;
  arm.default_limit = limits;
  return arm;
}

static orthocas_arm with_memory(void) {
  orthocas_arm arm = plain();
  arm.kernels.remember = remembered;
  arm.kernels.add_memory = add_memory;
  arm.memory = 2 * N;
  arm.memory_torque = N;
  arm.memory_start = nothing;
  return arm;
}

static orthocas_arm with_orientation(void) {
  orthocas_arm arm = plain();
  arm.kernels.turned = turned_at;
  arm.kernels.moved = moved_from;
  arm.kernels.turned_by = turned_by;
  arm.kernels.is_clear = is_clear;
  arm.turned_end = M;
  arm.phi_turn = phi_turn;
  arm.phi_rounds = phi_rounds;
  arm.turns = turns;
  return arm;
}

static orthocas_arm with_gram(int folds) {
  orthocas_arm arm = plain();
  arm.kernels.gram = gram_at;
  if (folds) arm.kernels.room_to_fold = room_to_fold;
  arm.boundary.bound = 0.1;
  arm.boundary.span = 0.9;
  return arm;
}

static orthocas_arm in_corridor(void) {
  orthocas_arm arm = plain();
  arm.boundary = (orthocas_boundary){2, 2, joints, radius, line_start, line_axis, line_length, 0.0, 0.0};
  return arm;
}

/* ---- a program around it ---- */

static const orthocas_arm *arm;
static orthocas_state state;
static orthocas_safety safety;
static orthocas_reference reference, given;
static double numbers[48 * N + 2 * N * N], settings[21][N], values[6][K], work[WORK];
static double q[N], dq[N], command[N], limit[N], used[2 * N];
static const double anything[N] = {INFINITY, INFINITY, INFINITY};

static void set(double *x, double a, double b, double c) {
  x[0] = a;
  x[1] = b;
  x[2] = c;
}

static void fill_settings(void) {
  const double defaults[21] = {1e4, 6, 0.5, 0.15, 4, 20, -3, 3, 900, 0, 0.05, 60, 30, 0.6, 0.5, 0.0, 0.2, 2, 0, 0, INFINITY};
  const double **places[21] = {&safety.command_rate, &safety.speed_limit, &safety.rest_speed, &safety.stuck_speed,
                               &safety.reference_speed, &safety.reference_acceleration, &safety.lower, &safety.upper,
                               &safety.stop_stiffness, &safety.observer_rate, &safety.stop_zone, &safety.stop_damping,
                               &safety.brake_yield, &safety.error_limit, &safety.offset_rate, &safety.integral_rate,
                               &safety.integral_limit, &safety.start_mismatch, &safety.friction,
                               &safety.encoder_step, &safety.contact_torque};
  int i;
  for (i = 0; i < 21; ++i) {
    set(settings[i], defaults[i], defaults[i], defaults[i]);
    *places[i] = settings[i];
  }
  safety.near_margin = 0.06;
  safety.catch_margin = 0.01;
  safety.return_margin = 0.1;
  safety.fade_in = 0.02;
  safety.fade_out = 0.03;
  safety.return_speed = 0.3;
  safety.longest_period = 0.02;
  safety.damping = 12;
  safety.brake_stiffness = 144;
  safety.energy_limit = INFINITY;
  safety.energy_rate = 10;
  safety.hold_ticks = 3;
  safety.stale_ticks = 5;
}

static void open_all(const orthocas_arm *which) {
  double *next = numbers, **places[] = {&state.q, &state.dq, &state.seen_q, &state.seen_dq, &state.command, &state.led,
                                        &state.impulse, &state.impulse_from, &state.law, &state.anchor, &state.safe,
                                        &state.limit, &state.offset, &state.integral, &state.load, &state.drive,
                                        &state.speed, &state.expected, &state.unexplained, &state.momentum, &state.trend,
                                        &state.touch, &state.carried, &state.apart, &state.gone, &state.same_q, &state.same_dq,
                                        &state.reference.value, &state.reference.velocity,
                                        &state.reference.acceleration};
  size_t i;
  memset(&state, 0, sizeof state);
  memset(numbers, 0, sizeof numbers);
  memset(values, 0, sizeof values);
  for (i = 0; i < sizeof places / sizeof *places; ++i, next += N) *places[i] = next;
  state.inertia = next;
  state.memory = next + N * N;
  state.safety = &safety;
  arm = which;
  good();
  fill_settings();
  reference = (orthocas_reference){values[0], values[1], values[2]};
  given = (orthocas_reference){values[3], values[4], values[5]};
  set(limit, 50, 50, 50);
  set(q, 0.1, 0.1, 0.1);
  set(dq, 0, 0, 0);
}

static void start_law(const orthocas_arm *which) {
  static const double still[N] = {0};
  open_all(which);
  orthocas_begin(arm, &state, ORTHOCAS_LAW, q, still, work);
  orthocas_reference_at(arm, q, &reference, work);
}

static int wiggle = 0, honest = 0;

static int step(double period) {
  orthocas_gains gains = {gains_of, used, limit, used, gains_of + N};
  double seen[N];
  int i, status;
  copy(seen, q, N);
  seen[0] += 1e-7 * (wiggle = 1 - wiggle); /* encoders are never still */
  for (i = 0; i < N && !honest; ++i) /* most tests set speeds alone: positions need not go as they tell */
    state.apart[i] = state.gone[i] = state.same_q[i] = state.same_dq[i] = 0;
  memset(used, 0, sizeof used);
  status = orthocas_step(arm, &state, orthocas_check_settings(arm, &safety), seen, dq, &reference, &gains, period, command, work);
  for (i = 0; i < N; ++i) CHECK(fabs(command[i]) <= state.limit[i]);
  CHECK(all_finite(arm, state.anchor, N) && all_finite(arm, state.offset, K) && all_finite(arm, state.integral, K));
  return status;
}

static int steps(int count) {
  int status = step(1e-3);
  for (; count > 1; --count) status = step(1e-3);
  return status;
}

/* ---- R1 to R4: chart, dynamics, inverse map ---- */

static void test_chart(void) {
  double phi[N], matrix[N * N], other[N], third[N];
  int k;
  double *faults[] = {&fault.phi, &fault.jacobian, &fault.curvature, &fault.mass, &fault.bias, &fault.gravity};
  for (k = 0; k < 6; ++k) {
    good();
    *faults[k] = NAN;
    CHECK(orthocas_chart(arm, q, phi, matrix) == (k < 2 ? ORTHOCAS_SINGULAR : ORTHOCAS_OK));
    CHECK(orthocas_curvature(arm, q, dq, dq, phi) == (k == 2 ? ORTHOCAS_SINGULAR : ORTHOCAS_OK));
    CHECK(orthocas_dynamics(arm, q, dq, matrix, phi, other) == (k > 2 ? ORTHOCAS_NOT_FINITE : ORTHOCAS_OK));
    CHECK(k <= 2 || (!(fabs(matrix[0]) > 0.0) && !(fabs(phi[0]) > 0.0) && !(fabs(other[0]) > 0.0)));
  }
  good();
  set(third, 0, NAN, 0);
  CHECK(orthocas_chart(arm, third, phi, matrix) == ORTHOCAS_NOT_FINITE);
  CHECK(orthocas_curvature(arm, third, dq, dq, phi) == ORTHOCAS_NOT_FINITE);
  CHECK(orthocas_curvature(arm, q, third, dq, phi) == ORTHOCAS_NOT_FINITE);
  CHECK(orthocas_curvature(arm, q, dq, third, phi) == ORTHOCAS_NOT_FINITE);
  CHECK(orthocas_dynamics(arm, third, dq, matrix, phi, other) == ORTHOCAS_NOT_FINITE);
  CHECK(orthocas_dynamics(arm, q, third, matrix, phi, other) == ORTHOCAS_NOT_FINITE);
  set(third, 1.6, 0, 0);
  CHECK(orthocas_chart(arm, third, phi, matrix) == ORTHOCAS_OUTSIDE_DOMAIN);
  CHECK(orthocas_curvature(arm, third, dq, dq, phi) == ORTHOCAS_OUTSIDE_DOMAIN);
  CHECK(orthocas_dynamics(arm, third, dq, matrix, phi, other) == ORTHOCAS_OUTSIDE_DOMAIN);
  set(third, 1.45, 1.45, 0);
  CHECK(inside(arm, third) == (arm->kernels.is_clear == 0));
}

static void test_inverse(void) {
  double phi[N] = {0.3, 0.2, 0.1}, from[N], to[N], room[ORTHOCAS_NEAREST_WORK(N, ROOMS)];
  int held[ORTHOCAS_NEAREST_HELD(N, ROOMS)], k;
  good();
  set(from, 0.5, 0.5, 0.5);
  CHECK(orthocas_inverse(arm, phi, from, 50, to, room) == ORTHOCAS_OK);
  CHECK(fabs(atan(to[0]) - phi[0]) < 1e-9 && fabs(to[1] - phi[1]) < 1e-9);
  set(phi, 0.3, 0.2, 0.1 + 6.283185307179586);
  CHECK(orthocas_inverse(arm, phi, from, 50, to, room) == ORTHOCAS_OK);
  CHECK(fabs(to[2] - (arm->phi_turn != 0 ? 0.1 : phi[2])) < 1e-9);
  CHECK(orthocas_inverse(arm, phi, from, 1, to, room) == ORTHOCAS_STOPPED_EARLY);
  for (k = 2; k < 12; ++k) {
    set(from, 8.0, 0, 0); /* Newton's steps of atan go too far: they are halved, or end where phi is undefined */
    CHECK(orthocas_inverse(arm, phi, from, k, to, room) != ORTHOCAS_NOT_FINITE);
  }
  set(phi, 1.55, 0, 0);
  set(from, 0, 0, 0);
  CHECK(orthocas_inverse(arm, phi, from, 60, to, room) == ORTHOCAS_OUTSIDE_DOMAIN);
  set(phi, 1.6, 0, 0); /* no angle has this tangent */
  CHECK(orthocas_inverse(arm, phi, from, 100, to, room) != ORTHOCAS_OK);
  set(from, 60, 0, 0);
  CHECK(orthocas_inverse(arm, phi, from, 50, to, room) == ORTHOCAS_SINGULAR);
  CHECK(orthocas_nearest(arm, phi, from, 1.0, to, room, held) == ORTHOCAS_SINGULAR);
  set(from, NAN, 0, 0);
  CHECK(orthocas_inverse(arm, phi, from, 50, to, room) == ORTHOCAS_NOT_FINITE);
  CHECK(orthocas_nearest(arm, phi, from, 1.0, to, room, held) == ORTHOCAS_NOT_FINITE);
  CHECK(orthocas_inverse(arm, from, phi, 50, to, room) == ORTHOCAS_NOT_FINITE);
  CHECK(orthocas_nearest(arm, from, phi, 1.0, to, room, held) == ORTHOCAS_NOT_FINITE);
  set(from, 0.5, 0.5, 0.5);
  CHECK(orthocas_nearest(arm, phi, from, NAN, to, room, held) == ORTHOCAS_NOT_FINITE);
  fault.singular = 1;
  CHECK(orthocas_inverse(arm, phi, from, 50, to, room) == ORTHOCAS_SINGULAR);
  fault.phi = NAN;
  CHECK(orthocas_inverse(arm, phi, from, 50, to, room) == ORTHOCAS_SINGULAR);
  /* The nearest position. */
  good();
  set(phi, 0.3, 0.2, 0.1);
  CHECK(orthocas_nearest(arm, phi, from, 1.0, to, room, held) == ORTHOCAS_OK);
  CHECK(orthocas_nearest(arm, phi, from, 0.01, to, room, held) == ORTHOCAS_STOPPED_EARLY);
  for (k = 0; k < N; ++k) CHECK(fabs(to[k] - from[k]) <= 0.01 + 1e-12);
  set(phi, 0.8, 0.9, 0.9);
  CHECK(orthocas_nearest(arm, phi, from, 0.01, to, room, held) == ORTHOCAS_STOPPED_EARLY);
  for (k = 0; k < N; ++k) CHECK(fabs(to[k] - from[k]) <= 0.01 + 1e-12);
  set(phi, 5, 5, 0);
  set(from, 1.0, 0.3, 0);
  CHECK(orthocas_nearest(arm, phi, from, 10.0, to, room, held) != ORTHOCAS_OK);
  CHECK(inside(arm, to) && to[0] * to[0] + to[1] * to[1] < 4.0);
  set(phi, -5, -5, 3);
  CHECK(orthocas_nearest(arm, phi, from, 10.0, to, room, held) != ORTHOCAS_OK);
  CHECK(inside(arm, to));
  for (k = 0; k < 5; ++k) { /* it stays inside, whatever kernels return */
    good();
    if (k == 0) fault.near = NAN;
    if (k == 1) fault.inwards = NAN;
    if (k == 2) fault.rank = 1;
    if (k == 3) fault.inwards = -1e200;
    if (k == 4) fault.near = 1e99;
    CHECK(orthocas_nearest(arm, phi, from, 10.0, to, room, held) != ORTHOCAS_OK);
    CHECK(all_finite(arm, to, N) && inside(arm, to));
  }
  good();
}

static void test_control(void) {
  double turned[N];
  good();
  CHECK(orthocas_control(arm, q, dq, &reference, gains_of, command, work) == ORTHOCAS_OK);
  copy(turned, command, N);
  q[2] += 6.283185307179586;
  CHECK(orthocas_control(arm, q, dq, &reference, gains_of, command, work) == ORTHOCAS_OK);
  CHECK((fabs(command[2] - turned[2]) < 1e-9) == (arm->turns != 0));
  q[2] -= 6.283185307179586;
}

/* ---- R5: settings and limits ---- */

static void test_settings(void) {
  double *scalars[] = {&safety.near_margin, &safety.catch_margin, &safety.return_margin, &safety.fade_in, &safety.fade_out,
                       &safety.return_speed, &safety.longest_period, &safety.damping, &safety.brake_stiffness,
                       &safety.energy_rate, &safety.energy_limit};
  const double bad[] = {NAN, -1.0, 0.0, INFINITY};
  size_t i, b;
  start_law(arm);
  for (i = 0; i < 21; ++i) {
    const int any = i < 2 || (i > 2 && i < 8) || i == 13 || i == 17 || i == 18 || i == 20;
    const int only_torque = (i > 8 && i < 13) || i > 17;
    fill_settings();
    CHECK(orthocas_check_settings(arm, &safety));
    settings[i][1] = NAN;
    CHECK(orthocas_check_settings(arm, &safety) == (only_torque && !arm->torque));
    settings[i][1] = -1.0;
    CHECK(orthocas_check_settings(arm, &safety) == (i == 6 || i == 7 || (only_torque && !arm->torque)));
    settings[i][1] = INFINITY;
    CHECK(orthocas_check_settings(arm, &safety) == (any || (only_torque && !arm->torque)));
  }
  for (i = 0; i < sizeof scalars / sizeof *scalars; ++i)
    for (b = 0; b < 4; ++b) {
      fill_settings();
      *scalars[i] = bad[b];
      CHECK(orthocas_check_settings(arm, &safety) == ((i > 7 && !arm->torque) || (i == 10 && b == 3)));
    }
  fill_settings();
  safety.hold_ticks = -1;
  CHECK(!orthocas_check_settings(arm, &safety));
  fill_settings();
  safety.stale_ticks = -1;
  CHECK(!orthocas_check_settings(arm, &safety));
  fill_settings();
  safety.near_margin = safety.catch_margin;
  CHECK(!orthocas_check_settings(arm, &safety));
  fill_settings();
  safety.near_margin = safety.return_margin;
  CHECK(!orthocas_check_settings(arm, &safety));
  fill_settings();
  safety.return_margin = 1.0;
  CHECK(!orthocas_check_settings(arm, &safety));
  fill_settings();
  CHECK(step(1e-3) == ORTHOCAS_OK);
  limit[1] = NAN; /* the last limit holds */
  CHECK(step(1e-3) == ORTHOCAS_BAD_INPUT);
  CHECK(state.limit[1] > 49.0);
}

/* ---- R6 to R8, R27: sensors ---- */

static void test_start(void) {
  double torque[N] = {1.0, -1.5, 2.5}, mismatch[N], place[N];
  int i;
  open_all(arm);
  set(q, 0.1, 0.2, 0.3); /* 0.1 q holds it: as fallback, and as gravity of a velocity law */
  CHECK(orthocas_check_start(arm, &safety, q, torque, gains_of, mismatch, work) == ORTHOCAS_LOAD_MISMATCH);
  for (i = 0; i < N; ++i) CHECK(fabs(mismatch[i] - (torque[i] - 0.1 * q[i])) < 1e-12);
  torque[2] = 2.0;
  CHECK(orthocas_check_start(arm, &safety, q, torque, gains_of, mismatch, work) == ORTHOCAS_OK);
  torque[0] = -1.98;
  CHECK(orthocas_check_start(arm, &safety, q, torque, gains_of, mismatch, work) == ORTHOCAS_OK);
  torque[0] = -2.0;
  CHECK(orthocas_check_start(arm, &safety, q, torque, gains_of, mismatch, work) == ORTHOCAS_LOAD_MISMATCH);
  for (i = 0; i < N; ++i) { /* what is no number is refused, wherever it is */
    set(torque, 0, 0, 0);
    torque[i] = i == 1 ? INFINITY : NAN;
    CHECK(orthocas_check_start(arm, &safety, q, torque, gains_of, mismatch, work) == ORTHOCAS_NOT_FINITE);
    CHECK(!(fabs(mismatch[0]) + fabs(mismatch[1]) + fabs(mismatch[2]) > 0.0));
    torque[i] = 0;
    copy(place, q, N);
    place[i] = NAN;
    CHECK(orthocas_check_start(arm, &safety, place, torque, gains_of, mismatch, work) == ORTHOCAS_NOT_FINITE);
    place[i] = 1e9;
    CHECK(orthocas_check_start(arm, &safety, place, torque, gains_of, mismatch, work) == ORTHOCAS_NOT_FINITE);
  }
  *(arm->torque ? &fault.fallback : &fault.gravity) = NAN;
  CHECK(orthocas_check_start(arm, &safety, q, torque, gains_of, mismatch, work) == ORTHOCAS_NOT_FINITE);
  good();
  settings[17][1] = NAN;
  CHECK(orthocas_check_start(arm, &safety, q, torque, gains_of, mismatch, work) == ORTHOCAS_BAD_INPUT);
  settings[17][1] = INFINITY; /* a joint that nobody checks */
  torque[1] = 1e9;
  CHECK(orthocas_check_start(arm, &safety, q, torque, gains_of, mismatch, work) == ORTHOCAS_OK);
}

static void test_sensors(void) {
  int k;
  start_law(arm);
  CHECK(steps(2) == ORTHOCAS_OK);
  q[2] += 6.283185307179586; /* whole turns mean nothing */
  CHECK(step(1e-3) == ORTHOCAS_OK);
  q[2] -= 6.283185307179586;
  q[1] = NAN;
  for (k = 0; k < 3; ++k) {
    double before[N];
    copy(before, command, N);
    CHECK(step(1e-3) == ORTHOCAS_BAD_INPUT);
    CHECK(state.mode == ORTHOCAS_LAW && !(fabs(command[0] - before[0]) > 0.0)); /* held */
  }
  CHECK(step(1e-3) == ORTHOCAS_BAD_INPUT);
  CHECK(state.mode == ORTHOCAS_CATCHER && state.cause == ORTHOCAS_BAD_INPUT);
  CHECK(step(1e-3) == ORTHOCAS_BAD_INPUT);
  q[1] = 0.1;
  CHECK(step(1e-3) == ORTHOCAS_CAUGHT);
  start_law(arm); /* the last bad tick ends the law at the next good measurement */
  (void)steps(2);
  q[1] = NAN;
  (void)steps(3);
  q[1] = 0.1;
  state.mode = ORTHOCAS_LAW;
  CHECK(step(1e-3) == ORTHOCAS_CAUGHT);
  CHECK(state.cause == ORTHOCAS_BAD_INPUT);
  start_law(arm);
  (void)steps(2);
  dq[0] = INFINITY;
  CHECK(step(1e-3) == ORTHOCAS_BAD_INPUT);
  dq[0] = 500; /* absurd: q does not move so */
  CHECK(step(1e-3) == ORTHOCAS_BAD_INPUT);
  dq[0] = 0;
  CHECK(step(1e-3) == ORTHOCAS_OK);
  q[0] += 0.9; /* a jump */
  CHECK(step(1e-3) == ORTHOCAS_BAD_INPUT);
  q[0] -= 0.9;
  CHECK(step(1e-3) == ORTHOCAS_OK);
  dq[0] = 400; /* a true one, as q moves alike; a light joint may be fast for a moment */
  for (k = 0; k < 6 && state.mode == ORTHOCAS_LAW; ++k) {
    q[0] += k == 0 ? 0.2 : 0.4;
    CHECK(step(1e-3) != ORTHOCAS_BAD_INPUT);
  }
  CHECK(state.mode == ORTHOCAS_CATCHER);
  CHECK(step(NAN) == ORTHOCAS_BAD_INPUT);
  CHECK(step(-1.0) == ORTHOCAS_BAD_INPUT);
  CHECK(step(1e7) == ORTHOCAS_BAD_INPUT);
  /* Sensors that stand still while they claim a speed, or while commands must have moved the arm. */
  for (k = 0; k < 4; ++k) { /* friction may hold it */
    int tick, seen = 0;
    start_law(arm);
    (void)steps(2);
    if (k == 0) set(dq, 0.1, 0, 0);
    if (k == 1) fault.law = 20.0;
    if (k == 2) fault.singular = 1; /* its inertia is not known */
    if (k == 3) {
      fault.law = 20.0;
      set(settings[18], 25.0, 25.0, 25.0);
    }
    for (tick = 0; tick < 60; ++tick) {
      wiggle = 1;
      seen |= step(1e-3) == ORTHOCAS_BAD_INPUT;
    }
    CHECK(k == 2 || seen == (k < 2 || !arm->torque));
  }
  /* Sensors that freeze in motion and report no speed: found unless friction can have stopped the arm, or it was
   * slow. The command goes back, and the arm is as fast as it was. */
  for (k = 0; k < 4; ++k) {
    double before;
    int tick;
    start_law(arm);
    set(settings[18], k == 1 ? 100.0 : 1.0, 1.0, 1.0);
    if (k == 3) set(settings[9], 50.0, 50.0, 50.0);
    set(dq, k == 2 ? 0.015 : 0.3, 0, 0);
    for (tick = 0; tick < 40; ++tick) {
      (void)step(1e-3);
      q[0] += 1e-3 * dq[0];
    }
    before = command[0];
    dq[0] = 0.0;
    fault.law = 1.0;
    for (tick = 0; tick < 8; ++tick) {
      const int status = (wiggle = 1, step(1e-3));
      CHECK((status == ORTHOCAS_BAD_INPUT) == (arm->torque && k == 0 && tick >= 5));
    }
    CHECK(!(arm->torque && k == 0) || (state.dq[0] > 0.2 && fabs(command[0] - before) < 1e-9));
    CHECK(state.mode == ORTHOCAS_LAW);
  }
  /* Of one joint: speeds that freeze (k < 2) while positions go on, positions (2) while speeds do, or both (3). What is
   * left of them tells how fast it is. Seen again, all is well. With an observer (4), nobody knows. */
  honest = 1;
  for (k = 0; k < 5; ++k) {
    int tick, seen = 0;
    start_law(arm);
    if (k == 4) set(settings[9], 50.0, 50.0, 50.0);
    set(dq, 0.2, 0, 0);
    for (tick = 0; tick < 400 && !seen; ++tick) {
      const int froze = tick >= 100;
      if (froze && k == 0) dq[0] = 0.0;
      if (k == 2) dq[0] = 0.2 + 1e-3 * (tick % 2);
      if (froze && k > 1) wiggle = 1;
      if (froze && k > 1) q[1] += 1e-6; /* the others go on */
      if (step(1e-3) == ORTHOCAS_BAD_INPUT) seen = tick;
      if (!froze || k < 2) q[0] += 1e-3 * (froze && k == 1 ? -0.2 : 0.2);
    }
    CHECK(!arm->torque || k == 4 ? !seen : seen > 100 && seen < 200 && state.mode == ORTHOCAS_CATCHER);
    if (!seen) continue;
    CHECK(state.cause == ORTHOCAS_BAD_INPUT);
    for (tick = 0; tick < 100; ++tick) {
      if (k == 2) dq[0] = 0.2 + 1e-3 * (tick % 2);
      if (k > 1) wiggle = 1;
      q[1] += 1e-6;
      if (k < 2) q[0] += k == 1 ? -2e-4 : 2e-4;
      orthocas_resume(&state);
      CHECK(step(1e-3) == ORTHOCAS_BAD_INPUT);
      CHECK(state.mode == ORTHOCAS_CATCHER);
    }
    CHECK(k > 2 || fabs(state.dq[0] - (k == 1 ? -0.2 : 0.2)) < 0.01);
    CHECK(k < 2 || state.q[0] > q[0]);
    q[0] += 0.01;
    dq[0] = 0.0;
    CHECK(k < 2 || step(1e-3) != ORTHOCAS_BAD_INPUT);
    CHECK(k < 2 || fabs(state.q[0] - q[0]) < 1e-6);
  }
  honest = 0;
  start_law(arm);
  (void)steps(2);
  state.same_ticks = rules.forever;
  wiggle = 1;
  (void)step(1e-3);
  wiggle = 1;
  (void)step(1e-3);
  CHECK(state.same_ticks <= rules.forever);
}

/* ---- R9 to R12, R18 to R22, R25, R26: modes ---- */

static void test_modes(void) {
  double held[N] = {1, 1, 1};
  int k;
  open_all(arm); /* well inside, the law takes over by itself */
  orthocas_begin(arm, &state, ORTHOCAS_CATCHER, q, 0, work);
  orthocas_reference_at(arm, q, &reference, work);
  CHECK(step(1e-3) == ORTHOCAS_OK);
  CHECK(steps(40) == ORTHOCAS_OK);
  CHECK(state.weight >= 1.0);
  open_all(arm); /* with a command; at a position that is none; with a command that is none */
  orthocas_begin(arm, &state, ORTHOCAS_CATCHER, q, held, work);
  CHECK(fabs(state.command[0] - 1.0) < 1e-12);
  held[1] = NAN;
  orthocas_begin(arm, &state, ORTHOCAS_CATCHER, held, held, work);
  CHECK(step(1e-3) == ORTHOCAS_CAUGHT || step(1e-3) == ORTHOCAS_OK);
  open_all(arm); /* outside, the catcher holds the arm; the way back */
  set(q, 1.49, 0, 0);
  orthocas_begin(arm, &state, ORTHOCAS_CATCHER, q, 0, work);
  orthocas_reference_at(arm, q, &reference, work);
  CHECK(steps(3) == ORTHOCAS_CAUGHT);
  orthocas_resume(&state);
  CHECK(steps(2) == ORTHOCAS_RETURNING);
  q[1] = NAN; /* no measurements on the way */
  CHECK(steps(5) == ORTHOCAS_BAD_INPUT);
  CHECK(state.mode == ORTHOCAS_CATCHER);
  q[1] = 0;
  CHECK(step(1e-3) == ORTHOCAS_CAUGHT);
  orthocas_resume(&state);
  for (k = 0; k < 5000 && state.mode != ORTHOCAS_LAW; ++k) {
    (void)step(1e-3);
    copy(q, state.anchor, N);
  }
  CHECK(state.mode == ORTHOCAS_LAW);
  /* On the way, it does not work, so the anchor goes on to the centre; then a joint is too fast. */
  open_all(arm);
  set(q, 1.49, 0, 0);
  orthocas_begin(arm, &state, ORTHOCAS_CATCHER, q, 0, work);
  (void)steps(2);
  orthocas_resume(&state);
  fault.status = ORTHOCAS_SINGULAR;
  for (k = 0; k < 8000; ++k) {
    (void)step(1e-3);
    copy(q, state.anchor, N);
  }
  CHECK(state.mode == ORTHOCAS_RETURN && fabs(q[0]) < 0.8);
  dq[0] = 0.3;
  fault.status = ORTHOCAS_OK;
  CHECK(step(1e-3) == ORTHOCAS_RETURNING); /* inside, but not at rest yet */
  dq[0] = 6.5; /* for a moment, a light joint may */
  CHECK(steps(5) == ORTHOCAS_RETURNING);
  CHECK(step(1e-3) == ORTHOCAS_CAUGHT);
  CHECK(state.cause == ORTHOCAS_TOO_FAST);
  orthocas_resume(&state);
  CHECK(step(1e-3) == ORTHOCAS_CAUGHT); /* too fast to resume */
  dq[0] = 0;
  CHECK(step(0.03) == ORTHOCAS_CAUGHT); /* late */
  CHECK(steps(3) != ORTHOCAS_CAUGHT);
  /* Causes. */
  start_law(arm);
  (void)steps(2);
  fault.status = ORTHOCAS_SINGULAR;
  CHECK(step(1e-3) == ORTHOCAS_CAUGHT);
  CHECK(state.cause == ORTHOCAS_SINGULAR);
  start_law(arm);
  (void)steps(2);
  dq[0] = -6.1;
  CHECK(steps(6) == ORTHOCAS_CAUGHT);
  CHECK(state.cause == ORTHOCAS_TOO_FAST || state.cause == ORTHOCAS_OUTSIDE_DOMAIN);
  /* A law that made joints fast gives way: at once what drives a joint on, all else together, whatever the law wants. */
  start_law(arm);
  set(settings[0], 1000, 1000, 1000);
  fault.law = 20;
  (void)steps(40);
  set(dq, 6.1, -0.1, 0);
  for (k = 0; k < 8 && state.mode == ORTHOCAS_LAW; ++k) (void)step(1e-3);
  CHECK(state.mode == ORTHOCAS_CATCHER && state.cause == ORTHOCAS_TOO_FAST);
  CHECK((fabs(state.law[0]) > 0.0) == !arm->torque && state.law[1] > 15.0 && state.law[2] > 15.0);
  fault.law = -20;
  for (k = 0; k < 5; ++k) {
    const double had = state.law[1], before = state.weight;
    double left = 0.0;
    (void)step(1e-3);
    for (int i = 0; i < N && arm->torque; ++i) left = fmax(left, fabs(state.drive[i] - state.load[i]));
    CHECK(!(fabs(state.law[1] - had) > 0.0));
    CHECK(fabs(before - state.weight - (arm->torque ? before / left : 1e-3 / 0.03)) < 1e-12);
  }
  /* Torques that drive a joint are foreseen until they are taken back; not those that a wall balances, as a blow comes. */
  start_law(arm);
  set(settings[0], 1000, 1000, 1000);
  fault.law = 80;
  for (k = 0; k < 200 && state.mode == ORTHOCAS_LAW; ++k) {
    (void)step(1e-3);
    dq[0] += 1e-3 * (command[0] - 0.1 * q[0]);
  }
  CHECK(state.mode == ORTHOCAS_CATCHER && state.cause == ORTHOCAS_TOO_FAST && (dq[0] < 5.6 || !arm->torque));
  start_law(arm);
  set(settings[0], 1000, 1000, 1000);
  fault.law = 20;
  (void)steps(40);
  for (k = 0; k < 16; ++k) {
    dq[0] -= 0.3;
    (void)step(1e-3);
  }
  CHECK(state.mode == ORTHOCAS_LAW);
  start_law(arm);
  (void)steps(2);
  set(q, 0.14, 0.1, 0.1);
  dq[0] = 0.1;
  CHECK(step(0.03) == ORTHOCAS_CAUGHT);
  CHECK(state.cause == ORTHOCAS_LATE);
  start_law(arm);
  (void)steps(2);
  fault.status = ORTHOCAS_SATURATED;
  CHECK(step(1e-3) == ORTHOCAS_SATURATED);
  fault.status = ORTHOCAS_OK;
  fault.law = 1e4;
  CHECK(step(1e-3) == ORTHOCAS_SATURATED);
  fault.law = NAN;
  (void)step(1e-3);
  fault.fallback = NAN;
  CHECK(steps(2) != ORTHOCAS_BAD_INPUT);
  open_all(arm); /* near the boundary; beyond it */
  set(q, 1.43, 0, 0);
  orthocas_begin(arm, &state, ORTHOCAS_LAW, q, dq, work);
  orthocas_reference_at(arm, q, &reference, work);
  CHECK(steps(2) == ORTHOCAS_NEAR_BOUNDARY || arm->boundary.lines > 0);
  q[0] = -1.49;
  orthocas_begin(arm, &state, ORTHOCAS_LAW, q, dq, work);
  CHECK(step(1e-3) == ORTHOCAS_CAUGHT);
  CHECK(state.cause == ORTHOCAS_OUTSIDE_DOMAIN);
  /* The spring gives way, stops push back, loads are learned, and a fast arm is slowed down. */
  for (k = 0; k < 300; ++k) {
    q[0] = -1.49 - 0.006 * k;
    dq[0] = k % 2 ? -2.0 : 2.0;
    CHECK(step(1e-3) == ORTHOCAS_CAUGHT);
  }
  for (k = 0; k < 300; ++k) {
    q[0] = 2.9 + 0.001 * k;
    dq[0] = 0.6;
    state.load[1] = state.load[0] = 20.0;
    (void)step(1e-3);
  }
  state.load[0] = NAN;
  CHECK(steps(2) != ORTHOCAS_OK);
  CHECK(!arm->torque || fabs(state.load[0]) <= 25.0);
  /* Brakes. */
  orthocas_stand(arm, &state, ORTHOCAS_HOLD, q, 0);
  CHECK(steps(5) == ORTHOCAS_CAUGHT);
  CHECK(state.cause == ORTHOCAS_HELD);
  orthocas_resume(&state);
  CHECK(!state.asked);
  q[0] = NAN;
  orthocas_stand(arm, &state, ORTHOCAS_CATCHER, q, held);
  set(q, 0, 0, 0);
  orthocas_stand(arm, &state, ORTHOCAS_CATCHER, q, limit);
  orthocas_resume(&state);
  CHECK(steps(3) != ORTHOCAS_BAD_INPUT);
}

/* ---- R13 to R17: the reference of the law ---- */

static void test_reference(void) {
  int k;
  double *faults[] = {&fault.deviation, &fault.gap, &fault.A, &fault.B};
  for (k = 0; k < 4; ++k) {
    start_law(arm);
    (void)steps(2);
    reference.value[0] += 1e-3;
    *faults[k] = k == 3 ? 1e200 : NAN;
    CHECK((step(1e-3) == ORTHOCAS_BAD_INPUT) == (k < 2));
    CHECK(all_finite(arm, state.reference.value, 3 * K));
  }
  open_all(arm); /* begins where nothing is measured */
  fault.deviation = NAN;
  orthocas_begin(arm, &state, ORTHOCAS_LAW, q, dq, work);
  orthocas_reference_at(arm, q, &reference, work);
  CHECK(all_finite(arm, state.reference.value, 3 * K) && all_finite(arm, reference.value, 3 * K));
  q[0] = NAN;
  orthocas_reference_at(arm, q, &reference, work);
  CHECK(all_finite(arm, reference.value, 3 * K));
  /* The catcher releases the arm where errors are no numbers. */
  open_all(arm);
  orthocas_begin(arm, &state, ORTHOCAS_CATCHER, q, 0, work);
  fault.deviation = NAN;
  (void)steps(2);
  CHECK(all_finite(arm, state.offset, K));
  start_law(arm); /* not finite; stands still and claims to move */
  (void)steps(2);
  reference.velocity[1] = NAN;
  CHECK(step(1e-3) == ORTHOCAS_BAD_INPUT);
  reference.velocity[1] = 0.0;
  reference.acceleration[1] = INFINITY;
  CHECK(step(1e-3) == ORTHOCAS_BAD_INPUT);
  reference.acceleration[1] = 0.0;
  reference.value[1] = NAN;
  CHECK(step(1e-3) == ORTHOCAS_BAD_INPUT);
  reference.value[1] = 0.1;
  reference.velocity[0] = 0.2;
  CHECK(steps(3) != ORTHOCAS_BAD_INPUT);
  CHECK(steps(3) == ORTHOCAS_BAD_INPUT);
  CHECK(!(fabs(state.reference.velocity[0]) > 0.0));
  /* A jump, too fast a reference, too strong an acceleration: it is led slowly, and the offset fades. */
  start_law(arm);
  (void)steps(2);
  reference.value[0] += 0.5;
  (void)step(1e-3);
  CHECK(fabs(state.offset[0]) > 0.3);
  (void)steps(4000);
  CHECK(fabs(state.offset[0]) < 0.01);
  reference.acceleration[0] = 500.0;
  (void)step(1e-3);
  reference.velocity[0] = 100.0;
  reference.value[0] += 0.1;
  (void)step(1e-3);
  fault.singular = 1;
  (void)steps(2);
  good();
  settings[14][0] = 0.0; /* it never fades */
  state.offset[0] = 0.1;
  (void)steps(2);
  CHECK(state.offset[0] > 0.09);
  /* Near the boundary it waits where it would lead on. */
  for (k = 0; k < 4; ++k) {
    open_all(arm);
    set(q, 1.4, 0, 0);
    orthocas_begin(arm, &state, ORTHOCAS_LAW, q, dq, work);
    orthocas_reference_at(arm, q, &reference, work);
    state.fresh = 0;
    fault.singular = k == 2;
    if (k == 3) fault.A = NAN;
    state.offset[0] = k == 1 ? 0.05 : -0.05;
    (void)step(1e-3);
    if (arm->kernels.gram == 0 && arm->boundary.lines == 0 && k < 2)
      CHECK((fabs(state.offset[0]) < 0.05) == (k == 1));
  }
  /* Integral action, not while the command is cut. */
  start_law(arm);
  set(settings[15], 1.0, 1.0, 1.0);
  reference.value[0] += 0.01;
  (void)steps(60);
  CHECK(fabs(state.integral[0]) > 0.0);
  /* No faster than the slowest mode bears, which the status says. */
  start_law(arm);
  set(settings[15], 50.0, 1.0, 1.0);
  reference.value[0] += 0.01;
  CHECK(step(1e-3) == ORTHOCAS_BAD_INPUT);
  state.integral[0] = 0.0;
  state.weight = 1.0;
  (void)step(1e-3);
  CHECK(fabs(state.integral[0]) > 0.0 && fabs(state.integral[0]) < 1.01 * 5.0 * 0.6 * 1e-3);
}

/* ---- R23: the observer ---- */

static void test_observer(void) {
  int k;
  start_law(arm);
  set(settings[9], 60.0, 0.0, 60.0);
  CHECK(steps(20) == ORTHOCAS_OK);
  settings[19][0] = 2e-3; /* within the step of its encoder, nothing is seen */
  q[0] = state.q[0] + 0.9e-3;
  state.dq[0] = state.expected[0] = 0.0;
  (void)step(1e-3);
  CHECK(fabs(state.dq[0]) <= 0.0);
  q[0] += 0.11; /* far off: it begins anew */
  (void)steps(30);
  for (k = 0; k < 3; ++k) {
    if (k == 0) fault.singular = 1;
    if (k == 1) fault.heavy = 1;
    if (k == 2) fault.mass = NAN;
    (void)steps(3);
    CHECK(all_finite(arm, state.expected, N) && all_finite(arm, state.dq, N));
    good();
  }
  orthocas_stand(arm, &state, ORTHOCAS_HOLD, q, 0);
  CHECK(steps(3) == ORTHOCAS_CAUGHT);
  orthocas_stand(arm, &state, ORTHOCAS_CATCHER, q, 0);
  q[1] = NAN;
  (void)steps(6);
  q[1] = 0.1;
  CHECK(steps(3) == ORTHOCAS_CAUGHT);
}

/* ---- R24: memory ---- */

static void test_memory(void) {
  double held[N] = {1, 2, 3}, none[N] = {NAN, 0, 0};
  open_all(arm);
  orthocas_begin(arm, &state, ORTHOCAS_CATCHER, q, held, work);
  CHECK(state.fresh == 2);
  (void)step(1e-3);
  CHECK(state.fresh == 0 && fabs(state.memory[N] - (1.0 - 0.01)) < 0.1);
  orthocas_begin(arm, &state, ORTHOCAS_CATCHER, q, none, work);
  CHECK(state.fresh == 1);
  orthocas_begin(arm, &state, ORTHOCAS_CATCHER, q, 0, work);
  CHECK(state.fresh == 1);
  orthocas_begin(arm, &state, ORTHOCAS_CATCHER, none, held, work); /* no measurement at the start: learned from the fallback there */
  set(q, NAN, 0, 0);
  CHECK(steps(5) == ORTHOCAS_BAD_INPUT);
  CHECK(state.fresh == 1);
  start_law(arm);
  (void)steps(30);
  fault.memory = NAN;
  (void)steps(2);
  CHECK(all_finite(arm, state.memory, 2 * N));
}

/* ---- R29, R30: references of programs ---- */

static void test_programs(void) {
  double target[K] = {0.3, 0.2, 0.4}, pace;
  int k;
  start_law(arm);
  (void)steps(2);
  orthocas_reference_at(arm, q, &given, work);
  for (k = 0; k < 3000; ++k)
    CHECK(orthocas_reference_stream(arm, state.q, state.dq, &safety, &given, target, 5.0, 1e-3, work) == ORTHOCAS_OK);
  CHECK(fabs(given.value[0] - 0.3) < 1e-3 && fabs(given.velocity[0]) < 1e-2);
  set(target, 9.0, 0, 0);
  CHECK(orthocas_reference_stream(arm, state.q, state.dq, &safety, &given, target, 5.0, 1e-3, work) == ORTHOCAS_NEAR_BOUNDARY);
  target[0] = NAN;
  CHECK(orthocas_reference_stream(arm, state.q, state.dq, &safety, &given, target, 5.0, 1e-3, work) == ORTHOCAS_NOT_FINITE);
  CHECK(all_finite(arm, given.value, 3 * K));
  target[0] = 0.3;
  for (k = 0; k < 8; ++k) {
    const double omegas[] = {0.0, NAN, 1e200, 5.0, 5.0, 5.0, 5.0, 5.0}, periods[] = {1e-3, 1e-3, 1e-3, -1.0, 1e-3, 1e-3, 1e-3, 1e-3};
    good();
    if (k == 4) fault.singular = 1;
    if (k == 5) fault.gap = NAN;
    if (k == 6) fault.deviation = 1e120;
    if (k == 7) fault.turned = NAN;
    (void)orthocas_reference_stream(arm, state.q, state.dq, &safety, &given, target, omegas[k], periods[k], work);
    CHECK(all_finite(arm, given.value, 3 * K));
  }
  good();
  given.velocity[0] = NAN;
  CHECK(orthocas_reference_stream(arm, state.q, state.dq, &safety, &given, target, 5.0, 1e-3, work) == ORTHOCAS_NOT_FINITE);
  CHECK(!(orthocas_reference_pace(arm, state.q, state.dq, state.led, &safety, &given, 1e-3, work) > 0.0));
  given.velocity[0] = 1e90;
  given.acceleration[0] = 1e99;
  (void)orthocas_reference_stream(arm, state.q, state.dq, &safety, &given, target, 1e6, 1e9, work);
  (void)orthocas_reference_stream(arm, state.q, state.dq, &safety, &given, target, 1e-90, 1e-3, work);
  CHECK(all_finite(arm, given.value, 3 * K));
  set(given.velocity, 20.0, 0, 0);
  set(given.acceleration, 0, 0, 0);
  CHECK(!(orthocas_reference_pace(arm, state.q, state.dq, state.led, &safety, &given, 0.0, work) > 0.0));
  pace = orthocas_reference_pace(arm, state.q, state.dq, anything, &safety, &given, 1e-3, work);
  CHECK(fabs(pace - 0.2) < 1e-12 && fabs(given.velocity[0] - 4.0) < 1e-12);
  /* Splines: at both ends, with times and targets that are none. */
  start_law(arm);
  set(target, 0.3, 0.2, 0.4);
  orthocas_reference_at(arm, q, &given, work);
  CHECK(orthocas_reference_spline(arm, &given, target, 2.0, 2.0, &reference, work) == ORTHOCAS_OK);
  CHECK(fabs(reference.value[0] - 0.3) < 1e-12 && fabs(reference.velocity[0]) < 1e-12);
  CHECK(orthocas_reference_spline(arm, &given, target, 0.0, 0.0, &reference, work) == ORTHOCAS_OK);
  CHECK(orthocas_reference_spline(arm, &given, target, 2.0, NAN, &reference, work) == ORTHOCAS_NOT_FINITE);
  CHECK(orthocas_reference_spline(arm, &given, target, INFINITY, 0.0, &reference, work) == ORTHOCAS_NOT_FINITE);
  reference.value[0] = NAN;
  target[0] = NAN;
  CHECK(orthocas_reference_spline(arm, &given, target, 2.0, 1.0, &reference, work) == ORTHOCAS_NOT_FINITE);
  CHECK(all_finite(arm, reference.value, 3 * K));
}

static void test_boundary(void) {
  double inner[N];
  const double couplings[] = {0.0, 0.3, -0.3};
  int k;
  for (k = 0; k < 3; ++k) {
    fault.coupling = couplings[k];
    set(q, k == 1 ? 0.0 : 0.2, 0.3, 0);
    CHECK(distance(arm, q, dq, 0.0, clearance(arm, q, work), work) <= 1.0);
    CHECK(distance(arm, q, anything, 0.0, clearance(arm, q, work), work) <= 1.0);
    set(inner, 1.0, -1.0, 0.0);
    CHECK(distance(arm, q, inner, 0.5, 1.0, work) <= distance(arm, q, inner, 0.0, 1.0, work));
  }
  fault.gram = -5.0; /* no norm has such a square */
  CHECK(distance(arm, q, dq, 0.0, clearance(arm, q, work), work) <= 1.0);
  good();
  set(q, 1.45, 1.45, 0);
  well_inside(arm, q, 0.8, inner, work);
  CHECK(inside(arm, inner) || arm->kernels.is_clear != 0);
  set(q, 0.2, 0.0, 0);
  well_inside(arm, q, 0.8, inner, work);
  CHECK(fabs(inner[0] - 0.2) < 1e-12);
}

/* ---- R32: contacts ---- */

static int gap_at(const double *q, double *gap, double *gradient, double *points, int *pair) {
  int i;
  *gap = 0.5 - q[0];
  *pair = 0;
  for (i = 0; i < N; ++i) gradient[i] = i == 0 ? -1.0 : 0.0;
  for (i = 0; i < 6; ++i) points[i] = 0.0;
  return fault.inwards > 0.0 ? 3 : 0;
}

static void test_contacts(void) {
  int k;
  start_law(arm);
  set(dq, 0.5, 0.0, 0.0);
  for (k = 0; k < 1000 && state.mode == ORTHOCAS_LAW; ++k) {
    q[0] += 0.5e-3;
    reference.value[0] = q[0];
    (void)step(1e-3);
  }
  CHECK(state.mode == ORTHOCAS_CATCHER && state.cause == ORTHOCAS_OUTSIDE_DOMAIN);
  CHECK(q[0] < 0.481 - 0.5 * (safety.fade_out + 1.0 / safety.damping) && q[0] > 0.3);
  fault.inwards = 1.0; /* no distance */
  CHECK(contact_room(arm, q, work) < 0.0);
  good();
}

/* ---- R33, R34: guarded moves, and the energy that commands give ---- */

static void test_guarded(void) {
  double felt = 0.0, load = 0.0, given = 0.0;
  int k;
  start_law(arm); /* something holds the arm against 4 N m: its torque is felt at 60 1/s, and its load learned at 2 1/s */
  (void)steps(2);
  set(settings[20], 3.0, 3.0, 3.0);
  fault.law = 4.0;
  (void)step(1e-3);
  for (k = 0; k < 200 && state.mode == ORTHOCAS_LAW; ++k) {
    (void)step(1e-3);
    felt += 0.06 * (-4.0 - felt);
    load += 0.002 * (4.0 - load);
    CHECK(fabs(state.touch[1] - felt) < 1e-9 && fabs(state.load[1] - load) < 1e-9);
    CHECK(state.mode == ORTHOCAS_CATCHER || -felt - load < 3.0 + 0.06);
  }
  CHECK(state.cause == ORTHOCAS_TOUCHED && -felt - load > 3.0 - 0.06);
  orthocas_resume(&state); /* not while it is felt; then it is a load */
  CHECK(steps(2) == ORTHOCAS_CAUGHT);
  CHECK(state.asked && state.mode == ORTHOCAS_CATCHER);
  fault.law = 0.0;
  (void)steps(300);
  CHECK(state.mode == ORTHOCAS_LAW);
  open_all(arm); /* nor on the way back */
  set(q, 1.49, 0, 0);
  orthocas_begin(arm, &state, ORTHOCAS_CATCHER, q, 0, work);
  (void)steps(2);
  orthocas_resume(&state);
  CHECK(steps(2) == ORTHOCAS_RETURNING);
  settings[20][0] = 1e-6;
  CHECK(steps(5) == ORTHOCAS_CAUGHT && state.cause == ORTHOCAS_TOUCHED);
  start_law(arm); /* a joint moves on while the law drives it: energy is torque times way, less what is allowed */
  safety.energy_limit = 0.05;
  safety.energy_rate = 0.5;
  fault.law = 6.0;
  set(dq, 0, 0.5, 0);
  (void)steps(2);
  given = state.energy;
  for (k = 0; k < 200 && state.mode == ORTHOCAS_LAW; ++k) {
    const double before = command[1]; /* torques of C(q, dq) move energy within the arm, and do not count */
    q[1] += 0.5e-3;
    (void)step(1e-3);
    given += ((before - 0.1 * state.q[1]) * 0.5 - 0.5) * 1e-3;
    CHECK(fabs(state.energy - given) < 1e-9 && (state.mode == ORTHOCAS_CATCHER || given < 0.05 + 2e-3));
  }
  CHECK(state.cause == ORTHOCAS_TOUCHED && given > 0.05);
  (void)steps(200); /* the catcher takes it back, and so does time */
  CHECK(!(state.energy > 0.0));
}

/* Measurements end while the arm moves: its command brakes it as foreseen, and goes on to what holds it. */
static void test_blind(void) {
  double least = 0.0;
  int k;
  start_law(arm);
  set(dq, 0.0, 0.4, 0.0);
  for (k = 0; k < 400; ++k) {
    (void)step(1e-3);
    q[2] = NAN;
    if (k == 20) least = state.command[1] - 0.1 * state.q[1];
  }
  q[2] = 0.0;
  CHECK(state.mode == ORTHOCAS_CATCHER && least < -0.5);
  CHECK(fabs(state.dq[1]) < 0.02);
}

int main(void) {
  const orthocas_arm arms[] = {plain(), with_memory(), with_orientation(), with_gram(0), with_gram(1), in_corridor()};
  orthocas_arm velocity = plain(), touching = plain();
  size_t k;
  velocity.torque = 0;
  for (k = 0; k < sizeof arms / sizeof *arms; ++k) {
    open_all(arms + k);
    test_chart();
    test_inverse();
    test_control();
    test_settings();
    test_start();
    test_sensors();
    test_modes();
    test_reference();
    test_observer();
    test_blind();
    test_guarded();
    test_programs();
    open_all(arms + k);
    test_boundary();
    if (arms[k].memory > 0) test_memory();
  }
  touching.kernels.gap_of_links = gap_at;
  touching.contact_margin = 0.02;
  open_all(&touching);
  test_contacts();
  open_all(&velocity);
  test_settings();
  test_start();
  test_sensors();
  test_modes();
  test_reference();
  printf("%d failures\n", failures);
  return failures > 100 ? 100 : failures;
}
